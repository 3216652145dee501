"""ROS 2 over Zenoh as rmw_zenoh speaks it, with the wheels eclipse-zenoh and rosbags alone.

Data keys ``<domain>/<topic>/<type>/<hash>``, liveliness tokens ``@ros2_lv/...``, and an attachment of sequence number,
time and 16 bytes of identity: github.com/ros2/rmw_zenoh, docs/design.md.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import struct
import time
from collections.abc import Callable
from typing import Any

from rosbags.typesys import Stores, get_typestore

from gpvo.errors import GpvoError, require
from gpvo.live.outputs import Send

_QOS_PUBLISHER = "::,10:,:,:,,"  # reliable, volatile, keep last 10: what differs from the default is written
_QOS_SUBSCRIBER = "2::,10:,:,:,,"  # best effort
_KEPT = 100
_QOS_KEPT = f":1:,{_KEPT}:,:,:,,"  # transient local


def dds_name(msgtype: str) -> str:
    """``nav_msgs/msg/Odometry`` as ROS 2 calls it on the wire."""
    package, _, name = msgtype.split("/")
    return f"{package}::msg::dds_::{name}_"


class ZenohWire:
    """A session with the router or peer at ``address`` (``tcp/HOST:PORT``), by default the router on this machine.

    ``address`` beginning with ``listen:`` waits for others there instead.
    """

    ros1 = False

    def __init__(self, address: str | None = None, domain: int = 0, node: str = "gpvo") -> None:
        require("zenoh")
        import zenoh

        self.store, self._zenoh = get_typestore(Stores.ROS2_JAZZY), zenoh
        self._domain, self._node, self._ids = domain, node, itertools.count(1)
        config: Any = zenoh.Config()
        is_listening = address is not None and address.startswith("listen:")
        place = (address or "tcp/127.0.0.1:7447").removeprefix("listen:")
        config.insert_json5("mode", json.dumps("router" if is_listening else "client"))
        config.insert_json5(f"{'listen' if is_listening else 'connect'}/endpoints", json.dumps([place]))
        config.insert_json5("scouting/multicast/enabled", "false")
        try:
            self._session: Any = zenoh.open(config)
        except zenoh.ZError as error:
            reason = str(error).splitlines()[0][:120]
            raise GpvoError(f"no Zenoh at {place}: {reason}", cure="start rmw_zenohd, or give --address") from None
        self._encoding = zenoh.Encoding("application/cdr")
        zid = self._session.zid()
        self._root = f"@ros2_lv/{domain}/{zid}/0"
        self._held: list[Any] = [self._session.liveliness().declare_token(f"{self._root}/0/NN/%/%/{node}")]

    def subscribe(self, topic: str, msgtype: str, deliver: Callable[[str, bytes], None], *, kept: bool = False) -> None:
        """Deliver every message of a topic, whatever hash its publisher knows the type by."""
        self._announce("MS", topic, msgtype, _QOS_KEPT if kept else _QOS_SUBSCRIBER)
        key = f"{self._domain}/{topic.strip('/')}/{dds_name(msgtype)}/*"

        def taken(sample: Any) -> None:
            deliver(topic, bytes(sample.payload))

        if not kept:
            self._held.append(self._session.declare_subscriber(key, taken))
            return
        # As rmw_zenoh subscribes to what is transient local: its publishers answer from a cache.
        from zenoh import ext

        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=_KEPT)
        self._held.append(
            ext.declare_advanced_subscriber(self._session, key, taken, history=history, subscriber_detection=True)
        )

    def advertise(self, topic: str, msgtype: str) -> Send:
        """Announce a topic; messages carry a sequence number, the time of sending and the publisher's identity."""
        token = self._announce("MP", topic, msgtype, _QOS_PUBLISHER)
        gid = hashlib.md5(token.encode(), usedforsecurity=False).digest()
        key = f"{self._domain}/{topic.strip('/')}/{dds_name(msgtype)}/{self.store.hash_rihs01(msgtype)}"
        # Zenoh drops what a busy link does not take at once, unless told to wait.
        publisher = self._session.declare_publisher(
            key, encoding=self._encoding, congestion_control=self._zenoh.CongestionControl.BLOCK
        )
        self._held.append(publisher)
        number = itertools.count(1)

        def send(data: bytes) -> None:
            publisher.put(data, attachment=struct.pack("<qqB", next(number), time.time_ns(), 16) + gid)

        return send

    def close(self) -> None:
        """End the session."""
        self._session.close()

    def _announce(self, kind: str, topic: str, msgtype: str, qos: str) -> str:
        mangled = "%" + topic.strip("/").replace("/", "%")
        token = (
            f"{self._root}/{next(self._ids)}/{kind}/%/%/{self._node}/{mangled}/{dds_name(msgtype)}/"
            f"{self.store.hash_rihs01(msgtype)}/{qos}"
        )
        self._held.append(self._session.liveliness().declare_token(token))
        return token
