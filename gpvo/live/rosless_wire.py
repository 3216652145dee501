"""ROS 2 without ROS, by wheels alone: over Zenoh as rmw_zenoh speaks it (eclipse-zenoh), over DDS (cyclonedds).

Zenoh: data keys ``<domain>/<topic>/<type>/<hash>``, liveliness tokens ``@ros2_lv/...``, and an attachment of sequence
number, time and 16 bytes of identity: github.com/ros2/rmw_zenoh, docs/design.md. DDS: topic ``rt/<topic>``, type
``<package>::msg::dds_::<Name>_``, hash of the type in USER_DATA: github.com/ros2/rmw_cyclonedds,
rmw_cyclonedds_cpp/src/rmw_node.cpp. Messages are those that rosbags' types know.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import struct
import threading
import time
from collections.abc import Callable
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from gpvo.errors import GpvoError, require
from gpvo.live.outputs import Send, Wire
from gpvo.publish import ros

_QOS_PUBLISHER = "::,10:,:,:,,"  # reliable, volatile, keep last 10: what differs from the default is written
_QOS_SUBSCRIBER = "2::,10:,:,:,,"  # best effort
_KEPT = 100
_QOS_KEPT = f":1:,{_KEPT}:,:,:,,"  # transient local
_DEPTH, _READER_DEPTH = 10, 100
# A reader that has stopped acknowledging would hold the end of the process for a second, cyclonedds' default.
_LINGER = "<Internal><WriterLingerDuration>100 ms</WriterLingerDuration></Internal>"


def _dds_name(msgtype: str) -> str:
    """``nav_msgs/msg/Odometry`` as ROS 2 calls it on the wire."""
    package, _, name = msgtype.split("/")
    return f"{package}::msg::dds_::{name}_"


class ZenohWire(Wire):
    """A session with the router or peer at ``address`` (``tcp/HOST:PORT``), by default the router on this machine.

    ``address`` beginning with ``listen:`` waits for others there instead.
    """

    def __init__(self, address: str | None = None, domain: int = 0, node: str = "gpvo") -> None:
        require("zenoh")
        import zenoh

        self.store, self._zenoh = get_typestore(Stores.ROS2_JAZZY), zenoh
        self._domain, self._node, self._ids = domain, node, itertools.count(1)
        config: Any = zenoh.Config()
        is_listening = address is not None and address.startswith("listen:")
        place = (address or "tcp/127.0.0.1:7447").removeprefix("listen:")
        config.insert_json5("mode", json.dumps("router" if is_listening else "client"))
        config.insert_json5("scouting/multicast/enabled", "false")
        try:
            config.insert_json5(f"{'listen' if is_listening else 'connect'}/endpoints", json.dumps([place]))
        except zenoh.ZError:
            raise GpvoError(f"'{place}' is not an address of Zenoh", cure="give tcp/HOST:PORT") from None
        try:
            self._session: Any = zenoh.open(config)
        except zenoh.ZError as error:
            reason = str(error).splitlines()[0].partition(" at /")[0]  # what follows is where Zenoh was built
            raise GpvoError(f"no Zenoh at {place}: {reason}", cure="start rmw_zenohd, or give --address") from None
        self._encoding = zenoh.Encoding("application/cdr")
        zid = self._session.zid()
        self._root = f"@ros2_lv/{domain}/{zid}/0"
        self._held: list[Any] = [self._session.liveliness().declare_token(f"{self._root}/0/NN/%/%/{node}")]

    def subscribe(self, topic: str, msgtype: str, deliver: Callable[[str, bytes], None], *, kept: bool = False) -> None:
        """Deliver every message of a topic, whatever hash its publisher knows the type by."""
        self._announce("MS", topic, msgtype, _QOS_KEPT if kept else _QOS_SUBSCRIBER)
        key = f"{self._domain}/{topic.strip('/')}/{_dds_name(msgtype)}/*"

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
        key = f"{self._domain}/{topic.strip('/')}/{_dds_name(msgtype)}/{self.store.hash_rihs01(msgtype)}"
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
            f"{self._root}/{next(self._ids)}/{kind}/%/%/{self._node}/{mangled}/{_dds_name(msgtype)}/"
            f"{self.store.hash_rihs01(msgtype)}/{qos}"
        )
        self._held.append(self._session.liveliness().declare_token(token))
        return token


class DdsWire(Wire):
    """A participant of a ROS domain: subscribes best effort, publishes reliably, keeps the last 10."""

    def __init__(self, domain: int = 0) -> None:
        require("cyclonedds")
        from cyclonedds.domain import DomainParticipant

        self.store = get_typestore(Stores.ROS2_JAZZY)
        settings = os.environ.get("CYCLONEDDS_URI", "")
        if _LINGER not in settings:  # the user's own come last, and win
            os.environ["CYCLONEDDS_URI"] = f"{_LINGER},{settings}" if settings else _LINGER
        self._participant: Any = DomainParticipant(domain)
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    def subscribe(self, topic: str, msgtype: str, deliver: Callable[[str, bytes], None], *, kept: bool = False) -> None:
        """Deliver every message of a topic from a thread of its own."""
        from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
        from cyclonedds.sub import DataReader
        from cyclonedds.util import duration

        lasting = (Policy.Reliability.Reliable(duration(seconds=1)), Policy.Durability.TransientLocal)
        qos = Qos(Policy.History.KeepLast(_READER_DEPTH), *(lasting if kept else (Policy.Reliability.BestEffort,)))
        reader: Any = DataReader(self._participant, self._topic(topic, msgtype), qos=qos)
        waiting = WaitSet(self._participant)
        waiting.attach(ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any))

        def work() -> None:
            while not self._stop.is_set():
                waiting.wait(200_000_000)
                for sample in reader.take(_READER_DEPTH):
                    if hasattr(sample, "cdr"):
                        deliver(topic, sample.cdr)

        thread = threading.Thread(target=work, name=f"gpvo-dds{topic}", daemon=True)
        thread.start()
        self._threads.append(thread)

    def advertise(self, topic: str, msgtype: str) -> Send:
        """Announce a topic, with the hash of its type for ROS 2 since Jazzy."""
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.util import duration

        qos = Qos(
            Policy.Reliability.Reliable(duration(milliseconds=100)),
            Policy.History.KeepLast(_DEPTH),
            Policy.Userdata(f"typehash={self.store.hash_rihs01(msgtype)};".encode()),
        )
        kind = raw_type(msgtype)
        writer: Any = DataWriter(self._participant, self._topic(topic, msgtype), qos=qos)

        def send(data: bytes) -> None:
            sample = kind.__new__(kind)
            sample.cdr = data
            writer.write(sample)

        return send

    def close(self) -> None:
        """End the threads."""
        self._stop.set()
        for thread in self._threads:
            thread.join(1.0)

    def _topic(self, topic: str, msgtype: str) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self._participant, "rt/" + topic.strip("/"), raw_type(msgtype))


@cache
def raw_type(msgtype: str) -> Any:
    """The IDL type of a message, whose samples are bytes: ``sample.cdr`` is what travels."""
    kind = _idl_type(msgtype)

    def deserialize(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
        sample = cls.__new__(cls)
        sample.cdr = bytes(data)
        return sample

    kind.serialize = lambda self, *_, **__: self.cdr
    kind.deserialize = classmethod(deserialize)
    return kind


@cache
def _idl_type(msgtype: str) -> Any:
    """cyclonedds' description of a message type, made of rosbags' definition."""
    from cyclonedds.idl import make_idl_struct

    store = get_typestore(Stores.ROS2_JAZZY)
    ros.register_px4(store)
    fields = store.fielddefs[msgtype][1]
    name = _dds_name(msgtype)
    return make_idl_struct(name.rsplit("::", 1)[1], name, {field: _idl_field(kind) for field, kind in fields})


def _idl_field(kind: Any) -> Any:
    from cyclonedds.idl import types as idl

    types: Any = idl
    node, of = kind
    if node == Nodetype.NAME:
        return _idl_type(of)
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        item, length = of
        inner = _idl_field(item)
        if node == Nodetype.ARRAY:
            return types.array[inner, length]
        return types.sequence[inner, length] if length else types.sequence[inner]
    name = of[0]
    return {"string": str, "bool": bool, "byte": types.uint8, "char": types.uint8}.get(name) or getattr(types, name)
