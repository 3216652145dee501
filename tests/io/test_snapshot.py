"""States between two frames as files: the same values, shared ones shared, and nothing that runs."""

from __future__ import annotations

import json
from collections import Counter, OrderedDict, deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from gpvo.io.snapshot import digest_of, load_snapshot, save_snapshot
from gpvo.types import Status, StereoCamera, VoRecord


def test_a_state_comes_back_as_it_was(tmp_path: Path) -> None:
    camera, shared = StereoCamera(60.0, 60.0, 32.0, 24.0, 0.1, 64, 48), np.arange(6.0)
    done: Future[tuple[int, ...]] = Future()
    done.set_result((1, 2))
    state = {
        "record": VoRecord(2**62, 1, Status.LOST, np.eye(4), reason="dark"),
        "camera": [camera, camera],
        "arrays": (shared, [shared], np.asfortranarray(np.ones((3, 4), np.float32)), np.zeros((0, 3), bool)),
        "numbers": [np.float64(0.1), np.int32(3), float("nan"), -0.0, True, None],
        "held": [deque([1, 2], maxlen=2), OrderedDict([(b"\x00", 1)]), Counter(a=2), {3: "x"}],
        "threads": ThreadPoolExecutor(1),
        "done": done,
    }
    save_snapshot(tmp_path / "s.npz", "key", state)
    back = load_snapshot(tmp_path / "s.npz", "key")
    assert back["camera"][0] == camera
    assert back["camera"][0] is back["camera"][1]
    assert back["arrays"][0] is back["arrays"][1][0]
    assert back["arrays"][2].flags.f_contiguous
    assert back["arrays"][2].dtype == np.float32
    assert back["arrays"][3].shape == (0, 3)
    assert type(back["numbers"][0]) is np.float64
    assert np.isnan(back["numbers"][2])
    assert str(back["numbers"][3]) == "-0.0"
    assert back["held"] == state["held"]
    assert back["held"][0].maxlen == 2
    assert type(back["held"][2]) is Counter
    assert (back["record"].t_ns, back["record"].status) == (2**62, Status.LOST)
    assert back["done"].result() == (1, 2)
    assert back["threads"].submit(int).result() == 0
    assert digest_of(back) == digest_of(state)
    assert digest_of(state, 1) != digest_of(state)


@pytest.mark.parametrize("odd", [np.random.default_rng(0), Path("x"), lambda: 0, np.array([object()])])
def test_what_it_cannot_hold_is_refused(odd: object, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="cannot hold"):
        save_snapshot(tmp_path / "s.npz", "key", [odd])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("node", [
    {"object": "os:system", "fields": {}}, {"object": "gpvo.types:np", "fields": {}},
    {"enum": "gpvo.vo.config:VoConfig", "value": 1},
    {"object": "gpvo.typesx:A", "fields": {}}, {"array": ["|O", [1], "C", 0]}, {"array": ["<f8", [10**9], "C", 0]},
    {"same": 5}, {"mapping": [], "is": "eval"}, {"number": ["<f8", [1], "C", -4]}, {"bytes": "x"}, {}, {"list": 3},
], ids=str)  # fmt: skip
def test_a_file_made_by_somebody_else_makes_nothing(node: dict, tmp_path: Path) -> None:
    text = json.dumps({"key": "key", "state": node}).encode()
    np.savez(tmp_path / "s.npz", tree=np.frombuffer(text, np.uint8), data=np.zeros(8, np.uint8))
    assert load_snapshot(tmp_path / "s.npz", "key") is None


def test_a_damaged_or_other_file_is_none(tmp_path: Path) -> None:
    assert load_snapshot(tmp_path / "s.npz", "key") is None
    save_snapshot(tmp_path / "s.npz", "key", [1, 2])
    assert load_snapshot(tmp_path / "s.npz", "other") is None
    raw = (tmp_path / "s.npz").read_bytes()
    for cut in range(0, len(raw), 7):
        (tmp_path / "s.npz").write_bytes(raw[:cut])
        assert load_snapshot(tmp_path / "s.npz", "key") is None


@pytest.mark.parametrize("value", [1e300, -1e300, np.array([0.0, 1e200]), np.array([1e38], np.float32)])
def test_numbers_beyond_all_measure_are_not_taken_up(value: object, tmp_path: Path) -> None:
    save_snapshot(tmp_path / "s.npz", "key", [value])
    back = load_snapshot(tmp_path / "s.npz", "key")
    assert (back is None) == (np.abs(value).max() > 1e100)
