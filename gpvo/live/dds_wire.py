"""ROS 2 over DDS without ROS, by the wheel cyclonedds; messages as rosbags' types know them.

Topic ``rt/<topic>``, type ``<package>::msg::dds_::<Name>_``, hash of the type in USER_DATA:
github.com/ros2/rmw_cyclonedds, rmw_cyclonedds_cpp/src/rmw_node.cpp.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from gpvo.errors import require
from gpvo.live.outputs import Send
from gpvo.live.zenoh_wire import dds_name
from gpvo.publish import ros

_DEPTH, _READER_DEPTH = 10, 100
# A reader that has stopped acknowledging would hold the end of the process for a second, cyclonedds' default.
_LINGER = "<Internal><WriterLingerDuration>100 ms</WriterLingerDuration></Internal>"


class DdsWire:
    """A participant of a ROS domain: subscribes best effort, publishes reliably, keeps the last 10."""

    ros1 = False

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
    kind = idl_type(msgtype)

    def deserialize(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
        sample = cls.__new__(cls)
        sample.cdr = bytes(data)
        return sample

    kind.serialize = lambda self, *_, **__: self.cdr
    kind.deserialize = classmethod(deserialize)
    return kind


@cache
def idl_type(msgtype: str) -> Any:
    """cyclonedds' description of a message type, made of rosbags' definition."""
    from cyclonedds.idl import make_idl_struct

    store = get_typestore(Stores.ROS2_JAZZY)
    ros.register_px4(store)
    fields = store.fielddefs[msgtype][1]
    name = dds_name(msgtype)
    return make_idl_struct(name.rsplit("::", 1)[1], name, {field: _idl_field(kind) for field, kind in fields})


def _idl_field(kind: Any) -> Any:
    from cyclonedds.idl import types as idl

    types: Any = idl
    node, of = kind
    if node == Nodetype.NAME:
        return idl_type(of)
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        item, length = of
        inner = _idl_field(item)
        if node == Nodetype.ARRAY:
            return types.array[inner, length]
        return types.sequence[inner, length] if length else types.sequence[inner]
    name = of[0]
    return {"string": str, "bool": bool, "byte": types.uint8, "char": types.uint8}.get(name) or getattr(types, name)
