"""The backend's command line. `python -m backend COMMAND --help` tells more of each.

  inspect      what a clip requires and why, what each preset costs; nothing is fitted
  reconstruct  from a video to particles and a VDB sequence, in a job folder
  run          the job in DIR/job.json, events as JSON lines (what the add-on calls)
  render       the fitted or forecast smoke from any camera
  forecast     the most likely next frames
  simulate     a physical rollout, for looks and editing
  export       the VDB sequence at another voxel size or for other frames
  evaluate     a finished job against the truth of a benchmark scene or of other cameras
  report       one picture: input, reconstruction, side view

Exit codes: 0 done or cancelled, 2 you can act (one sentence on what is wrong, one on what to do), 1 a defect.
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numpy and numba load, see there

# isort: split
import argparse
import logging
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

from backend import commands, evaluation
from backend.contract import events
from backend.contract.errors import EXIT_DEFECT, EXIT_DONE, EXIT_USER, BackendError, Cancelled
from backend.contract.job import DEVICES, PRESETS
from backend.contract.result import LOG_FILE
from backend.events_out import EventSink, PipeSink, StopRequest, TerminalSink, watch_standard_input

LONG_COMMANDS = ("run", "reconstruct", "forecast", "simulate")  # they send events when their output is a pipe


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    is_piped = options.command == "run" or (options.command in LONG_COMMANDS and not sys.stdout.isatty())
    sink: EventSink = PipeSink() if is_piped else TerminalSink(getattr(options, "job", None))
    stop = StopRequest()
    if options.command == "run":
        watch_standard_input(stop, sink)
    try:
        return guarded(lambda: options.work(options, sink, stop), sink, getattr(options, "job", None))
    finally:
        sink.close()


def guarded(work: Callable[[], None], sink: EventSink, job: Path | None) -> int:
    """Do the work of a command and turn how it ends into the last event and the exit code."""
    try:
        work()
    except (Cancelled, KeyboardInterrupt):
        sink.send(events.CancelledEvent())
        return EXIT_DONE
    except BrokenPipeError:  # whoever read our output, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return EXIT_DONE
    except BackendError as error:
        write_log(job, f"{error.code}: {error}")
        sink.send(events.Error(code=error.code, message=error.message, hint=error.hint, stage=error.stage))
        if isinstance(sink, PipeSink):
            print(f"wildsmoke: {error}", file=sys.stderr)  # for a person who reads the pipe's other end
        return EXIT_USER
    except Exception as error:  # noqa: BLE001 the one place where a defect becomes an event
        text = traceback.format_exc()
        where = write_log(job, text)
        if where is None:
            print(text, file=sys.stderr)
        message = f"The backend failed: {type(error).__name__}: {error}"
        hint = f"This is a defect: please report it with {where or 'the traceback'}."
        sink.send(events.Error(code="defect", message=message, hint=hint))
        return EXIT_DEFECT
    return EXIT_DONE


def write_log(job: Path | None, text: str) -> Path | None:
    """Append to the job's log, if there is a job folder that can be written to."""
    if job is None or not job.is_dir():
        return None
    try:
        with open(job / LOG_FILE, "a", encoding="utf-8") as log:
            log.write(text.rstrip() + "\n")
    except OSError:
        return None
    return job / LOG_FILE


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options of one command. Ends the process with code 2 and a sentence where they do not fit."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="wildsmoke", description=__doc__, formatter_class=form)
    choices = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, work: Callable[..., None]) -> argparse.ArgumentParser:
        description = (work.__doc__ or "").strip()
        added = choices.add_parser(name, description=description, formatter_class=form)
        added.set_defaults(work=work)
        return added

    inspect = command("inspect", commands.inspect_clip)
    inspect.add_argument("video")
    inspect.add_argument("--json", action="store_true", help="as JSON")
    _add_settings(inspect)
    _add_clip(inspect)

    reconstruct = command("reconstruct", commands.reconstruct)
    reconstruct.add_argument("video", help="a video, a folder of images, or a pattern such as shot_%%04d.png")
    _add_job(reconstruct)
    _add_settings(reconstruct)
    _add_clip(reconstruct)
    reconstruct.add_argument("--device", choices=DEVICES, default="auto")

    _add_job(command("run", commands.run))

    render = command("render", commands.render)
    _add_job(render)
    render.add_argument("--cameras", type=Path, required=True, help="cameras.json of the views to render")
    render.add_argument("--out", type=Path, required=True, help="folder for %%04d.png, by video frame number from 0")
    render.add_argument("--frames", type=frame_range, metavar="A:B", help="video frames A to B-1; all without it")

    forecast = command("forecast", commands.forecast)
    _add_job(forecast)
    forecast.add_argument("--frames", type=int, required=True, metavar="N", help="number of frames behind the fitted ones")

    simulate = command("simulate", commands.simulate)
    _add_job(simulate)
    simulate.add_argument("--frames", type=int, required=True, metavar="N")
    simulate.add_argument("--wind", type=vector, default=None, metavar="X,Y,Z", help="m/s; the learned one without it")
    simulate.add_argument("--buoyancy", type=float, default=1.0, metavar="S", help="times the learned one")
    simulate.add_argument("--collider", action="append", default=[], metavar="MESH", help="an .obj the smoke flows around")

    export = command("export", commands.export)
    _add_job(export)
    export.add_argument("--vdb", type=Path, required=True, metavar="DIR")
    export.add_argument("--voxel-size", type=float, default=0.0, metavar="M", help="m; 0 as the particles carry")
    export.add_argument("--frames", type=frame_range, metavar="A:B", help="video frames A to B-1; all without it")

    evaluate = command("evaluate", evaluation.evaluate)
    _add_job(evaluate)
    evaluation.add_options(evaluate)

    report = command("report", commands.report)
    _add_job(report)
    report.add_argument("--out", type=Path, required=True, metavar="PNG")
    return parser.parse_args(arguments)


def _add_job(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--job", type=Path, required=True, metavar="DIR", help="the job folder")


def _add_settings(parser: argparse.ArgumentParser) -> None:
    # Not argparse's choices: an unknown preset is answered by the contract, the same in every front end.
    parser.add_argument("--preset", default="preview", help=" | ".join(PRESETS))
    parser.add_argument("--set", dest="overrides", action="append", default=[], type=setting, metavar="section.field=value")


def _add_clip(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cameras", help="cameras.json of the clip")
    parser.add_argument("--frames", type=frame_range, metavar="A:B", help="frames A to B-1 only")


def setting(text: str) -> tuple[str, str]:
    """`section.field=value`."""
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise argparse.ArgumentTypeError(f"{text!r} is not section.field=value")
    return key.strip(), value.strip()


def frame_range(text: str) -> tuple[int | None, int | None]:
    """`A:B`, either end may be left out."""
    first, colon, last = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return (int(first) if first else None, int(last) if last else None)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not A:B") from None


def vector(text: str) -> tuple[float, float, float]:
    """`X,Y,Z`."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y,Z") from None
    return (x, y, z)


if __name__ == "__main__":
    logging.captureWarnings(True)
    sys.exit(main())
