"""``gpvo calibration``: what a run found wrong with its rig, and a corrected calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def calibration(
    run: Annotated[Path, typer.Argument(help="Run folder of gpvo run.")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Corrected Kalibr camera chain to write.")] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """Print the calibration errors that a run found; write a corrected calibration.

    Example: gpvo calibration runs/mine -o corrected.yaml
    """
    from gpvo.cli.output import jsonable, print_json
    from gpvo.errors import SourceError
    from gpvo.io.atomic import write_text
    from gpvo.io.jsonfile import read_json
    from gpvo.io.run import read_run
    from gpvo.vo.rig_findings import camchain, corrected, document, read_state, rig_of

    camera = read_run(run).log.camera
    if camera is None:
        raise SourceError("holds no camera: it was not made by gpvo run", where=run)
    state = read_state(run, camera)
    if out is not None:
        rig = corrected(rig_of(read_json(run / "rig.json").get("calibration"), camera), state, camera)
        write_text(out, camchain(rig))
    found = document(state, camera)
    if json_:
        print_json({"run": str(run), **jsonable(found)})
        return
    print("\n".join(found["findings"] or ["nothing found wrong between the cameras"]))
    if out is not None:
        print(f"{out}: corrected calibration; bends that no turn or focal length explains remain")


def register(app: typer.Typer) -> None:
    """Add this file's commands to the application."""
    app.command()(calibration)
