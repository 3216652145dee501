"""What all commands share: ``--config``, ``-q``, ``-v``, the flags that open a sequence, ``--help`` in groups."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from difflib import get_close_matches
from functools import wraps
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from gpvo.cli import output
from gpvo.cli.output import one_of
from gpvo.errors import GpvoError
from gpvo.files import read_toml
from gpvo.types import VEHICLES, StereoCamera, Vehicle

if TYPE_CHECKING:
    from gpvo.vo.config import VoConfig
    from gpvo.vo.rig_error import RigState


class Groups(TyperGroup):
    """The commands grouped by purpose; options from a file come before those of the command line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the options of ``--config FILE`` right after the command's name, where later ones override them."""
        name = next((a for a in args if not a.startswith("-")), None)
        command = self.get_command(ctx, name) if name else None
        paths = [w for w, before in zip(args[1:], args) if before == "--config"]
        paths += [a.partition("=")[2] for a in args if a.startswith("--config=")]
        if command is not None and paths:
            at = args.index(str(name)) + 1
            args = [*args[:at], *options_of_file(Path(paths[-1]), str(name), self.commands), *args[at:]]
        return list(super().parse_args(ctx, args))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section per group."""
        known: Mapping[str, Any] = self.commands  # typer's, which have a panel
        for title, commands in groupby(known.items(), lambda item: item[1].rich_help_panel):
            with formatter.section(title):
                formatter.write_dl([(name, (c.help or "").split("\n\n")[0].strip()) for name, c in commands])


CovarianceAxes = Annotated[
    str,
    "Axes of covariances: world, body, mixed (those of the rotation alone are the body's), or auto: body for those of"
    " motions; of poses, mixed for columns of OpenVINS' names, else world.",
]
Config = Annotated[Path | None, "TOML file of options, one table per command. The command line takes precedence."]
Quiet = Annotated[bool, "-q", "--quiet", "No progress and no notes."]
Verbose = Annotated[bool, "-v", "--verbose", "Also print settings, time and memory."]
_OPTIONS = {"config": (Config, None), "quiet": (Quiet, False), "verbose": (Verbose, False)}


def with_common_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """A command that also takes ``--config``, ``-q`` and ``-v``; each field of a dataclass becomes an option."""

    @wraps(function)
    def command(**given: Any) -> Any:
        quiet, verbose, _ = given.pop("quiet"), given.pop("verbose"), given.pop("config")
        with output.loudness(quiet=quiet, verbose=verbose):
            output.detail(", ".join(f"{k.rstrip('_')}={v}" for k, v in given.items() if isinstance(v, _PLAIN)))
            return _called(function, given)

    options = [*_options(function), *(_option(name, kind, default) for name, (kind, default) in _OPTIONS.items())]
    command.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in options}
    return command


def _options(asking: Any) -> Iterator[inspect.Parameter]:
    """Of a command, or a dataclass of settings, and of the dataclasses in it."""
    for name, kind, default in _asked(asking):
        yield from _options(kind) if is_dataclass(kind) else [_option(name, kind, default)]


def _called(asking: Any, given: dict[str, Any]) -> Any:
    """What comes of a command, or a dataclass, with the options that were given."""
    asked = _asked(asking)
    return asking(**{name: _called(kind, given) if is_dataclass(kind) else given[name] for name, kind, _ in asked})


def _asked(asking: Any) -> list[tuple[str, Any, Any]]:
    """Name, type and default of each parameter that has a help or such parameters of its own, and of typer's context:
    no other field of a dataclass is an option."""
    found = [(p.name, p.annotation, p.default) for p in inspect.signature(asking, eval_str=True).parameters.values()]
    return [
        (name, kind, default)
        for name, kind, default in found
        if hasattr(kind, "__metadata__") or is_dataclass(kind) or kind is typer.Context
    ]


def _option(name: str, kind: Any, default: Any) -> inspect.Parameter:
    """``kind``: typer's own annotation, or a type annotated with its help: before it may stand its words, if they are
    not its name, and after it what else typer is told. Without words, what has no default is an argument, but for
    ``out``, and a flag has no opposite."""
    told = getattr(kind, "__metadata__", ())
    if texts := [text for text in told if isinstance(text, str)]:
        words, more = texts[:-1], {"help": texts[-1], **next((m for m in told if isinstance(m, dict)), {})}
        is_argument = not words and default is inspect.Parameter.empty and name != "out"
        words = words or [*(["-o"] if name == "out" else []), f"--{name.rstrip('_').replace('_', '-')}"]
        kind = Annotated[kind.__origin__, typer.Argument(**more) if is_argument else typer.Option(*words, **more)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)


_PLAIN = (str, int, float, bool, list, Path)


def options_of_file(path: Path, name: str, commands: Mapping[str, Any]) -> list[str]:
    """Options of the command called ``name`` from its table in a TOML file, as words of a command line.

    Raises GpvoError, in one line, for a table that belongs to no command, an unknown option or a bad value.
    """
    found = read_toml(path)
    words: list[str] = []
    for key, value in found.items():
        if not isinstance(value, dict) or key not in commands:
            cure = f"write options under [{name}]"
            raise GpvoError(f"'{key}' is not the table of any command", where=path, cure=cure)
    command = commands[name]
    known = {word.lstrip("-").replace("-", "_"): p for p in command.params for word in p.opts if word.startswith("--")}
    del known["config"]
    context = command.context_class(command, info_name=name)
    for key, value in found.get(name, {}).items():
        option = known.get(key.replace("-", "_"))
        if option is None:
            near = get_close_matches(key.replace("-", "_"), known, 1)
            cure = f"did you mean {near[0]}?" if near else f"gpvo {name} --help lists them"
            raise GpvoError(f"[{name}] has no option '{key}'", where=path, cure=cure)
        kinds, cure = (bool, "give true or false") if option.is_flag else ((str, int, float), "give text or a number")
        values = value if isinstance(value, list) and not option.is_flag else [value]
        if not all(isinstance(v, kinds) for v in values):
            raise GpvoError(f"[{name}] {key} is {value!r}", where=path, cure=cure)
        if option.is_flag:
            words += [option.opts[0]] if value else option.secondary_opts[:1]
            continue
        texts = [str(v) for v in values]
        try:
            for text in texts:
                option.process_value(context, [text] if option.multiple else text)
        except typer.BadParameter as problem:
            raise GpvoError(f"[{name}] {problem.format_message()}", where=path) from None
        words += [word for text in texts for word in (option.opts[0], text)]
    return words


Kind = Annotated[str | None, "--source", "Format of the sequence; guessed by default."]
Overwrite = Annotated[bool, "Replace a finished run, once the new one is complete."]


@dataclass(frozen=True)
class ViewOptions:
    """How images are paired, read and rectified: options that go to :func:`gpvo.io.open_source`."""

    hfov_deg: Annotated[float | None, "Field of view of the virtual pinhole pair [deg]."] = None
    size: Annotated[str | None, "Size of the rectified images, WIDTHxHEIGHT."] = None
    mask_left: Annotated[Path | None, "Mask image for the left lens: which pixels may be used."] = None
    mask_right: Annotated[Path | None, "The same for the right lens."] = None
    tolerance_s: Annotated[
        float | None, "--pair-tolerance", "Largest difference between the stamps of a stereo pair [s]."
    ] = None
    bits: Annotated[int | None, "Bits in use per sample of 16-bit images, e.g. 12."] = None

    def given(self) -> dict[str, Any]:
        """Those that were given, parsed. Raises GpvoError if a size is not WIDTHxHEIGHT."""
        options = {name: value for name, value in vars(self).items() if value is not None}
        if "size" in options:
            from gpvo.cameras.rectify import read_size

            options["size"] = read_size(options["size"])
        return options


@dataclass(frozen=True)
class SequenceOptions(ViewOptions):
    """How a sequence is read."""

    calibration: Annotated[Path | None, "Calibration file to use instead of the one found."] = None
    left_topic: Annotated[str | None, "Topic of the left images in a bag."] = None
    right_topic: Annotated[str | None, "Topic of the right images in a bag."] = None
    base_frame: Annotated[
        str | None, "Robot frame of which gpvo publish is to speak, located through /tf_static and /tf of a bag."
    ] = None
    rate_hz: Annotated[float | None, "Frame rate of an image folder whose file names are numbers."] = None
    imu_topic: Annotated[str | None, "Topic of the IMU in a bag."] = None
    truth_topic: Annotated[str | None, "Topic of the ground truth in a bag; none to ignore it."] = None
    truth_frame: Annotated[
        str | None,
        "Frame of the poses in the truth topic: imu or cam; fit others with 'gpvo import RUN --align transform'.",
    ] = None


@dataclass(frozen=True)
class VehicleOptions:
    """What carries the camera."""

    vehicle: Annotated[str, "What carries the camera: car, rover, multirotor, handheld or any."] = "any"
    max_acceleration: Annotated[float | None, "Largest acceleration [m/s^2], overriding --vehicle."] = None
    max_turn: Annotated[float | None, "Largest angular acceleration [rad/s^2], likewise."] = None

    def bounds(self) -> Vehicle:
        """Those of the kind of vehicle, or the ones given to override them.

        Raises GpvoError if the kind is unknown or a bound is not above 0.
        """
        known = VEHICLES[one_of("--vehicle", self.vehicle, tuple(VEHICLES))]
        for flag, value in (("--max-acceleration", self.max_acceleration), ("--max-turn", self.max_turn)):
            if value is not None and not 0 < value < math.inf:
                raise GpvoError(f"{flag} is {value:g}", cure="give a number above 0")
        return Vehicle(self.max_acceleration or known.max_acceleration_mps2, self.max_turn or known.max_turn_radps2)


@dataclass(frozen=True)
class OdometryOptions:
    """Settings of gpvo's own odometry. A model knows only the odometry that it was trained on."""

    preset: Annotated[str, "Settings of the odometry: fast or thesis."] = "fast"
    methods: Annotated[str, "Covariances: triangulation, pointing_matching, spherical."] = (
        "triangulation,pointing_matching"
    )
    sigma_p: Annotated[
        str | None, "Pointing noise [px], or auto: estimated from the residuals, the default; 0.1 with --preset thesis."
    ] = None
    sigma_m: Annotated[str | None, "Matching noise [px], or auto: the default; 0.5 with --preset thesis."] = None
    sigma: Annotated[float, "Pixel noise of the triangulation method [px]."] = 1.0
    min_inliers: Annotated[int, "A motion with fewer inliers is lost; at least 4."] = 8
    weak_inliers: Annotated[int, "A motion with fewer inliers is degraded."] = 20
    window: Annotated[int, "Frames adjusted together (slower); 2 estimates each motion alone."] = 2
    settings: Annotated[
        list[str] | None, "--set", "Any setting of the odometry (gpvo.vo.config.VoConfig).", {"metavar": "NAME=VALUE"}
    ] = None
    self_calibration: Annotated[
        bool | None,
        "--self-calibration/--no-self-calibration",
        "Estimate calibration errors in flight. On by default, except with --preset thesis.",
    ] = None
    calibration_state: Annotated[
        Path | None, "Start from the calibration errors of an earlier run: its folder, or its calibration_state.json."
    ] = None

    def config(self, vehicle: Vehicle) -> VoConfig:
        """The settings, parsed. Raises GpvoError for an unknown one, or a value out of its range."""
        from gpvo.vo.config import make_config, read_settings

        own = {k: v for k, v in vars(self).items() if k not in ("preset", "settings", "calibration_state")}
        shorthand = {f"{k}_px" if k.startswith("sigma") else k: v for k, v in own.items() if v is not None}
        texts = [*(f"{k}={v}" for k, v in (asdict(vehicle) | shorthand).items()), *(self.settings or ())]
        return make_config(self.preset, **read_settings(texts))

    def state(self, camera: StereoCamera) -> RigState | None:
        """What an earlier run found out about the calibration, None if no run was named."""
        from gpvo.vo.rig_findings import read_state

        return None if self.calibration_state is None else read_state(self.calibration_state, camera)


def is_given(ctx: typer.Context, option: str) -> bool:
    """Whether the user gave an option, rather than leaving its default."""
    source = ctx.get_parameter_source(option)
    return source is not None and source.name != "DEFAULT"


def refuse_idle(ctx: typer.Context, names: Iterable[str], why: str, cure: str) -> None:
    """Raise GpvoError for the first of these options that the user gave, though nothing will read it: ``why``."""
    if idle := [name for name in names if is_given(ctx, name)]:
        raise GpvoError(f"--{idle[0].strip('_').replace('_', '-')} has no effect {why}", cure=cure)


def refuse_twice(paths: Iterable[Path]) -> None:
    """Raise GpvoError for one that is given twice: it would narrow every interval, and judge training on itself."""
    seen: set[Path] = set()
    for path in paths:
        if path.resolve() in seen:
            raise GpvoError("is given twice", where=path, cure="give each once: intervals count on separate ones")
        seen.add(path.resolve())
