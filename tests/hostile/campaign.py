"""Mutated inputs of every kind, read one after the other in a process with limits: ``campaign.py SEEDS FIRST COUNT``.

Each case is its number: the same number makes the same file. A line of JSON is printed for each case that does not end
as it has to: read, or refused by one line that names the file, in time and without much memory.
"""

from __future__ import annotations

import json
import re
import resource
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

EXTREME = tuple(
    word.encode()
    for word in (
        *["1e308", "-1e308", "1e999", "nan", ".inf", "-1", "0", "2147483648", "null", "[]", "{}", "1e-320", "true"],
        "9" * 400,
    )
)
VALUES = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e160, 0.0, -1.0, 1e-320, 1e12)
SECONDS, MEGABYTES = 10, 1000
_NUMBER = re.compile(rb"-?\d+\.?\d*(e[-+]?\d+)?")
Rng = np.random.Generator


# -- bytes --


def flip(raw: bytes, rng: Rng, other: bytes) -> bytes:
    out = bytearray(raw)
    for at in rng.integers(0, max(len(out), 1), rng.integers(1, 17)):
        if out:
            out[at] ^= 1 << int(rng.integers(8))
    return bytes(out)


def truncate(raw: bytes, rng: Rng, other: bytes) -> bytes:
    return raw[: int(rng.integers(0, max(len(raw), 1)))]


def splice(raw: bytes, rng: Rng, other: bytes) -> bytes:
    at, begin, n = (int(rng.integers(0, max(len(v), 1))) for v in (raw, other, other))
    return raw[:at] + other[begin : begin + min(n, 4096)] + raw[at + int(rng.integers(0, 4096)) :]


def numbers(raw: bytes, rng: Rng, other: bytes) -> bytes:
    found = list(_NUMBER.finditer(raw))
    if not found:
        return flip(raw, rng, other)
    hit = found[int(rng.integers(len(found)))]
    return raw[: hit.start()] + EXTREME[int(rng.integers(len(EXTREME)))] + raw[hit.end() :]


def swap(raw: bytes, rng: Rng, other: bytes) -> bytes:
    separator = (b"\n", b",", b" ", b":")[int(rng.integers(4))]
    fields = raw.split(separator)
    a, b = (int(k) for k in rng.integers(0, len(fields), 2))
    fields[a], fields[b] = fields[b], fields[a]
    return separator.join(fields)


def bomb(raw: bytes, rng: Rng, other: bytes) -> bytes:
    at, n = int(rng.integers(0, max(len(raw), 1))), int(rng.integers(1, 64))
    return raw[:at] + raw[at : at + n] * int(rng.integers(10, 20_000)) + raw[at:]


ANY_BYTES = (flip, truncate, splice, numbers, swap, bomb)


# -- arrays: files that are whole, with a content that cannot be --


def odd_array(array: np.ndarray, rng: Rng) -> np.ndarray:
    """Another array: some or all of its values extreme, or of another shape or type."""
    choice = int(rng.integers(6))
    if choice == 0:
        return np.asarray(array[:-1] if array.ndim else [array, array])
    if choice == 1:
        return np.asarray(array).astype(("f4", "i8", "U3", "?", "f8", "i4")[int(rng.integers(6))])
    if choice == 2:
        return np.atleast_1d(array).reshape(-1, 1)
    out = np.array(array, dtype=np.float64)
    value = VALUES[int(rng.integers(len(VALUES)))]
    if choice == 3 or not out.size:
        out[...] = value
    else:
        out.reshape(-1)[int(rng.integers(out.size))] = value
    return out


def odd_tracks(path: Path, rng: Rng) -> None:
    with np.load(path) as file:
        data = {name: file[name] for name in file.files}
    name = sorted(data)[int(rng.integers(len(data)))]
    data[name] = odd_array(data[name], rng)
    np.savez_compressed(path, **data)


def odd_model(path: Path, rng: Rng) -> None:
    from gpvo.errors import ModelError
    from gpvo.online import modelfile

    arrays, header = modelfile.load(path)
    arrays, names = dict(arrays), sorted(n for n in arrays if not n.startswith("thesis."))
    if rng.random() < 0.3:
        key = sorted(header)[int(rng.integers(len(header)))]
        header[key] = (None, -1, 0, [], {}, "x", [1.0], [[]], {"x": {}}, 1e300, True)[int(rng.integers(11))]
    else:
        name = names[int(rng.integers(len(names)))]
        arrays[name] = odd_array(arrays[name], rng)
    try:
        modelfile.save(path, arrays, header)
    except ModelError:
        path.write_bytes(flip(path.read_bytes(), rng, b""))


def odd_table(path: Path, rng: Rng) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    at = int(rng.integers(table.num_columns))
    name = table.column_names[at]
    if rng.random() < 0.2:
        table = table.remove_column(at)
    elif rng.random() < 0.2:
        table = table.set_column(at, name, pa.array(["x"] * table.num_rows))
    else:
        values = table[name].to_pylist()
        if values and isinstance(values[0], (int, float)) and not isinstance(values[0], bool):
            k = int(rng.integers(len(values)))
            value = VALUES[int(rng.integers(len(VALUES)))]
            whole = isinstance(values[0], int)
            values[k] = int(rng.integers(-(2**62), 2**62)) if whole else value
            table = table.set_column(at, name, pa.array(values, table[name].type))
    pq.write_table(table, path)


# -- readers --


def read_model(path: Path) -> None:
    from gpvo.cli.describe import describe
    from gpvo.geometry.covariance import is_positive_definite
    from gpvo.online.predictor import Predictor

    describe(path, None, {})
    predictor = Predictor.load(path)
    n = len(predictor.features)
    for x in (predictor.model.domain.centre, np.zeros(n), np.full(n, np.nan)):
        said = predictor.predict(x)
        assert is_positive_definite(said.covariance), "a covariance that is none"
        assert np.isfinite(said.mean).all(), "a mean that is none"


def read_run_folder(path: Path) -> None:
    from gpvo.geometry.covariance import are_positive_definite
    from gpvo.io.run import read_run

    run = read_run(path)
    assert np.isfinite(run.log.trajectory()).all(), "a trajectory that is none"
    told = list(flying_model().replay(run.log).values())
    assert are_positive_definite(np.array([p.covariance for p in told])).all(), "a covariance that is none"
    assert np.isfinite([p.mean for p in told]).all(), "a mean that is none"


@cache
def flying_model() -> Any:
    """The model that comes with gpvo."""
    from gpvo.online.predictor import Predictor

    return Predictor.load(Path(__file__).parents[2] / "models" / "tunnel.gpvo")


def read_source(path: Path) -> None:
    from gpvo.io import open_source

    for _ in zip(range(3), open_source(path)):
        pass


def read_yaml(path: Path) -> None:
    from gpvo.cameras.readers import read_stereo_yaml

    read_stereo_yaml(path)


def read_log(path: Path) -> None:
    from gpvo.io.foreign import read_foreign, to_records

    log = read_foreign(path, None, rate_hz=10.0)
    assert all(np.isfinite(r.T_prev_cur).all() for r in to_records(log)[0]), "a motion that is none"


def read_planned_path(path: Path) -> None:
    from gpvo.evaluation.plan import read_plan

    assert np.isfinite(read_plan(path, 0.1).motions).all(), "a motion that is none"


def read_settings(path: Path) -> None:
    from gpvo.io.toml import read_toml

    read_toml(path)


def read_image(path: Path) -> None:
    from gpvo.io.images import read_grey8

    read_grey8(path)


def read_bag(path: Path) -> None:
    from gpvo.io.bag_reader import POSE_TYPES, open_bag, read_poses, topics_of

    with open_bag(path) as reader:
        topics = list(topics_of(reader, POSE_TYPES))
    for topic in topics:
        read_poses(path, topic)


READERS: dict[str, tuple[Callable[[Path], None], Callable[[Path, Rng], None] | None]] = {
    "model": (read_model, odd_model),
    "tracks": (read_source, odd_tracks),
    "run": (read_run_folder, odd_table),
    "sequence": (read_source, None),
    "calibration": (read_yaml, None),
    "log": (read_log, None),
    "plan": (read_planned_path, None),
    "settings": (read_settings, None),
    "image": (read_image, None),
    "bag": (read_bag, None),
    "recording": (read_source, None),
}


# -- cases --


def mutated(seeds: Path, number: int, work: Path) -> tuple[str, Path, Path]:
    """The kind of a case, what is to be read, and the file in it that was changed."""
    rng = np.random.default_rng(number)
    kinds = [k for k in READERS if (seeds / k).is_dir()]
    kind = kinds[number % len(kinds)]
    chosen = sorted((seeds / kind).iterdir())
    seed = chosen[int(rng.integers(len(chosen)))]
    target = work / seed.name
    if seed.is_dir():
        shutil.copytree(seed, target)
        files = sorted(p for p in target.rglob("*") if p.is_file())
        changed = files[int(rng.integers(len(files)))]
    else:
        shutil.copy(seed, target)
        changed = target
    odd = READERS[kind][1]
    if odd is not None and rng.random() < 0.5 and changed.suffix in (".npz", ".gpvo", ".parquet"):
        odd(changed, rng)
    else:
        others = [p for p in sorted((seeds / kind).rglob("*")) if p.is_file()]
        mutate = ANY_BYTES[int(rng.integers(len(ANY_BYTES)))]
        other = others[int(rng.integers(len(others)))].read_bytes()
        changed.write_bytes(mutate(changed.read_bytes(), rng, other))
    return kind, target, changed


def problems(seeds: Path, first: int, count: int, work: Path) -> Iterator[dict[str, Any]]:
    """What went wrong, case by case, and which took more memory than any should."""
    from gpvo.errors import GpvoError

    def hang(*_: object) -> None:
        raise TimeoutError(f"longer than {SECONDS} s")

    signal.signal(signal.SIGPROF, hang)
    most_mb = MEGABYTES + 300.0  # of Python and its libraries
    for number in range(first, first + count):
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        (work.parent / f"{work.name}.case").write_text(str(number))
        kind, target, changed = mutated(seeds, number, work)
        case = {"case": number, "kind": kind, "file": changed.name}
        started, told = time.monotonic(), ""
        signal.setitimer(signal.ITIMER_PROF, SECONDS)  # of the processor: the machine may have other work
        try:
            with warnings.catch_warnings(record=True) as beside:
                warnings.simplefilter("always")
                READERS[kind][0](target)
        except GpvoError as refusal:
            told = str(refusal)
            if "\n" in told or target.name not in told:
                yield {**case, "problem": f"names no file: {told[:200]}"}
        except BaseException as error:
            yield {**case, "problem": f"{type(error).__name__}: {str(error)[:200]}", "s": time.monotonic() - started}
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        ours = [w for w in beside if "gpvo" in w.filename and issubclass(w.category, RuntimeWarning)]
        if ours:
            yield {**case, "problem": f"{ours[0].filename}:{ours[0].lineno}: {ours[0].message}"}
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        if peak_mb > most_mb:
            most_mb = 1.2 * peak_mb
            yield {**case, "problem": f"{peak_mb:.0f} MB {told[:200]}"}


def main() -> None:
    seeds, first, count = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    for problem in problems(seeds, first, count, seeds.parent / f"work-{first}"):
        print(json.dumps(problem), flush=True)


if __name__ == "__main__":
    main()
