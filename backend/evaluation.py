"""The command `evaluate`: a finished job against what is known to be true. Heavy imports wait until it is asked for."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from backend.contract import events
from backend.contract.result import read_result
from backend.contract.truth import INPUT_VIEW
from backend.events_out import EventSink, StageReport, StopRequest
from backend.io.job_folder import JobFolder


def add_options(parser: argparse.ArgumentParser) -> None:
    """All but --job."""
    parser.add_argument(
        "--truth", type=Path, required=True, metavar="DIR", help="a scene that `synth ship` made, or a set of cameras"
    )
    parser.add_argument("--input", default=INPUT_VIEW, metavar="NAME", help="of a set of cameras: the one that was fitted")
    parser.add_argument("--out", type=Path, metavar="JSON")
    parser.add_argument("--html", type=Path, metavar="HTML", help="a report with curves and pictures, in one file")
    parser.add_argument(
        "--relight", type=Path, metavar="DIR", help="draw the volumes with Cycles too; the pictures are kept in DIR"
    )
    parser.add_argument("--relight-frames", type=_positive, default=4, metavar="N", help="how many of them")
    parser.add_argument("--blender", type=Path, metavar="FILE", help="Blender, or a Python with bpy; found without it")
    parser.add_argument("--lpips", type=Path, nargs="+", metavar="FILE", help="weights of LPIPS or ST-LPIPS, kept by torch.save")


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not 1 or more")
    return value


def evaluate(options: argparse.Namespace, sink: EventSink, stop: StopRequest) -> None:
    """A finished job against the truth of a benchmark scene or of any set of cameras, beside what trivial answers get.

    Prints a table; docs/evaluate.md says how to read it, and how a set of cameras lies in its folder.
    """
    from backend.io.atomic import write_text
    from backend.score.finished_job import open_job, scores_of
    from backend.score.page.report import write_report
    from backend.score.perceptual import read_perceptual
    from backend.score.read_truth import read_truth
    from backend.score.relight import RelightConfig, find_blender, relight_scores
    from backend.score.text_table import table

    def begin(part: str) -> StageReport:
        sink.send(events.Stage(name=part, index=0, count=1))
        return StageReport(part, sink, stop)

    num_seen = read_result(options.job).num_frames
    truth = read_truth(options.truth, num_seen=num_seen, input_name=options.input)
    perceptual = read_perceptual(options.lpips) if options.lpips else None
    relight = None
    if options.relight is not None:
        blender = find_blender(options.blender)
        relight = RelightConfig(folder=options.relight, blender=blender, num_frames=options.relight_frames)
    with open_job(JobFolder(options.job), truth) as job:
        scores = scores_of(job, truth, perceptual=perceptual, begin=begin)
        if relight is None:
            scores["not_measured"]["relight"] = "--relight DIR draws the volumes with Cycles"
        else:
            scores |= relight_scores(options.job, job.prediction, truth, relight, report=begin("relight"))
        if options.html is not None:
            write_report(options.html, scores, job, truth, relight=relight, report=begin("report"))
    sink.close()
    print(table(scores))
    if options.out is not None:
        write_text(options.out, json.dumps(scores, indent=1, allow_nan=False) + "\n")
