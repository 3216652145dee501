"""``gpvo live``: images or anyone's odometry in, covariance out; ``gpvo doctor``: a linter for covariances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpvo.cli import common as flags
from gpvo.cli.files import import_log
from gpvo.cli.output import answer, one_of, print_json, say
from gpvo.errors import GpvoError, counted, printable
from gpvo.io.foreign import COVARIANCE_AXES, ForeignLog, read_foreign
from gpvo.io.run import read_run
from gpvo.live import POSE_TYPE_NAMES, LiveSettings, WireSettings
from gpvo.types import IMPORTED, Vehicle

if TYPE_CHECKING:
    from gpvo.live.stereo_stage import StereoSettings


def live(
    asked: LiveSettings,
    vehicle: flags.VehicleOptions = flags.VehicleOptions(),
    vo: flags.OdometryOptions = flags.OdometryOptions(),
    view: flags.ViewOptions = flags.ViewOptions(),
    depth: Annotated[int, "Queue length per topic; older messages are dropped.", {"min": 2}] = 10,
    json_: Annotated[bool, "Print the counts as JSON at the end."] = False,
) -> None:
    """Publish odometry with an honest covariance, live.

    Example: gpvo live --odometry /vins_estimator/odometry --model vins.gpvo --zenoh
    """
    from gpvo.live.job import run_live

    one_of("--odometry-type", asked.odometry_type, POSE_TYPE_NAMES)
    carrier = vehicle.bounds()
    one_of("--covariance-axes", asked.covariance_axes, COVARIANCE_AXES)
    one_of("--pose-covariance", asked.pose_covariance, ("accumulated", "increment"))
    stereo = _stereo_settings(vo, carrier, asked.stereo is not None, view.given())
    one_of("--truth-type", asked.truth_type, POSE_TYPE_NAMES)
    result = run_live(replace(asked, vo=stereo, vehicle=carrier, depth=depth))
    told = ", ".join(f"{name} {n}" for name, n in result["counts"].items()) or "nothing received"
    answer(json_, {"schema": 1, **result}, lambda: print(told))


def _stereo_settings(
    vo: flags.OdometryOptions, vehicle: Vehicle, has_images: bool, view: dict[str, Any]
) -> StereoSettings:
    """As ``gpvo run`` would read them; without images the vehicle alone is no setting of the odometry."""
    from gpvo.live.stereo_stage import StereoSettings

    if not has_images and vo == flags.OdometryOptions():
        return StereoSettings(**view)
    return StereoSettings(vo.config(vehicle), vo.calibration_state, **view)


def doctor(
    ctx: typer.Context,
    source: Annotated[str, "A bag, or a topic of a running system.", {"metavar": "TOPIC|BAG"}],
    topic: Annotated[str | None, "Topic in a bag; default: all that hold poses."] = None,
    truth: Annotated[Path | None, "Ground truth of the same body, a file or a bag: adds the NEES (bags only)."] = None,
    truth_topic: Annotated[str | None, "Topic of the ground truth in a bag."] = None,
    align: Annotated[str, "Fit a fixed transform between bag and truth, as gpvo import does."] = "none",
    covariance_axes: flags.CovarianceAxes = "auto",
    wire: WireSettings = WireSettings(),
    odometry_type: Annotated[str, "Type of a topic: odometry, pose, or pose_stamped."] = "odometry",
    seconds: Annotated[float, "How long to listen.", {"min": 1.0}] = 10.0,
    json_: Annotated[bool, "Print the findings as JSON."] = False,
) -> None:
    """Check anyone's covariance, and what each filter would do with it.

    Example: gpvo doctor flight.mcap --truth mocap.tum
    """
    from gpvo.live.doctor import examine_bag, examine_topic

    transport = wire.transport()
    one_of("--align", align, ("none", "rotation", "transform"))
    one_of("--covariance-axes", covariance_axes, COVARIANCE_AXES)
    if truth is None:
        flags.refuse_idle(ctx, ("truth_topic", "align", "covariance_axes"), "without ground truth", "add --truth")
    if truth is not None and transport is not None:
        cure = "record it first, or use gpvo live --truth TOPIC"
        raise GpvoError("--truth judges a bag, not a running topic", cure=cure)
    judged = {}
    if transport is None:
        found = examine_bag(Path(source), topic)
        if truth is not None:
            given = _truth_of(truth, truth_topic, Path(source))
            topics = [t for t in found if t != truth_topic]
            judged = {t: _nees_of_bag(Path(source), t, given, align, covariance_axes) for t in topics}
    else:
        kind = POSE_TYPE_NAMES[one_of("--odometry-type", odometry_type, POSE_TYPE_NAMES)]
        found = {source: examine_topic(transport, source, kind, seconds, wire.address, wire.domain)}
    if json_:
        rows = [
            {"topic": t, "findings": [f.__dict__ for f in findings], "nees": judged.get(t)}
            for t, findings in found.items()
        ]
        print_json({"schema": 1, "source": source, "topics": rows})
        return
    for name, findings in found.items():
        count = counted(len(findings), "fault") if findings else "nothing"
        print(f"{printable(name)}: {count} found")
        for finding in findings:
            for line in str(finding).splitlines():
                say(f"  {line}")
        for line in _lines(judged[name]) if name in judged else ():
            say(f"  {line}")


def _truth_of(truth: Path, topic: str | None, bag: Path) -> ForeignLog:
    """The ground truth of a bag, which may lie in it. GpvoError where its topic there is not named."""
    if topic is None and truth.exists() and truth.samefile(bag):
        raise GpvoError("which topic of the bag is the ground truth?", cure="name it with --truth-topic")
    return read_foreign(truth, topic=topic, complete=True)


def _nees_of_bag(bag: Path, topic: str, truth: ForeignLog, align: str, axes: str) -> dict[str, Any]:
    """NEES per degree of freedom of the ``poses`` and of the ``motions`` whose covariances a topic states: None, or by
    block of the error {``nees_dof``, ``interval``, ``median``} with the ``count``; and the ``problem`` where nothing
    could be judged. ``truth``: of the same body."""
    from gpvo.evaluation.evaluate import evaluate_run
    from gpvo.evaluation.trajectory import nees_document

    try:
        with TemporaryDirectory(prefix="gpvo-") as folder:
            log = read_foreign(bag, topic=topic, covariance_axes=axes)
            import_log(log, truth, Path(folder) / "run", frame=log.frame, align=align)
            evaluation = evaluate_run(read_run(Path(folder) / "run"))
    except GpvoError as error:
        return {"poses": None, "motions": None, "problem": str(error)}
    motions = nees_document(evaluation.consistency.get(IMPORTED))
    problem = None if motions or evaluation.poses else "no stated covariance can be judged"
    return {"poses": nees_document(evaluation.poses), "motions": motions, "problem": problem}


def _lines(found: dict[str, Any]) -> list[str]:
    if found["problem"]:
        return [f"NEES unknown: {found['problem']}"]
    out = []
    for what in ("poses", "motions"):
        if about := found[what]:
            by_block = {name: block for name, block in about.items() if name != "count"}
            joint = by_block.pop("joint")
            low, high = joint["interval"]
            each = ", ".join(f"{name} {block['nees_dof']:.3g}" for name, block in by_block.items())
            out.append(
                f"NEES per degree of freedom of {about['count']} {what}: {joint['nees_dof']:.3g}"
                f" [{low:.3g}, {high:.3g}], {each}: {_meaning(joint['nees_dof'], low, high)}"
            )
    return out


def _meaning(mean: float, low: float, high: float) -> str:
    """By the bounds of the verdict of ``gpvo evaluate``."""
    from gpvo.evaluation.verdict import HONEST

    slightly = "slightly " if HONEST[0] <= mean <= HONEST[1] else ""
    if low > 1.0:
        return f"{slightly}overconfident"
    return f"{slightly}too cautious" if high < 1.0 else "right, as far as this truth can tell"
