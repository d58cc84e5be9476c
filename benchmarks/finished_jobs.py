"""The options of what looks at the finished jobs of some scenes: the jobs, their scenes' truth, where figures go."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from backend.contract.result import RESULT_FILE
from benchmarks.reconstruction import SETS


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """jobs: folders, each named after its scene; source: the folder of scenes; json: None where figures are printed only."""

    parser: argparse.ArgumentParser
    jobs: list[Path]
    source: Path
    json: Path | None


def read_options(arguments: Sequence[str] | None, *, description: str | None) -> Asked:
    """Ends the program with a sentence where there is no finished job."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=Path, required=True)
    parser.add_argument("--from", dest="source", type=Path, default=SETS)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    jobs = sorted(path.parent for path in given.jobs.glob(f"*/{RESULT_FILE}"))
    if not jobs:
        parser.error(f"{given.jobs} holds no finished job; run benchmarks.reconstruction first.")
    return Asked(parser=parser, jobs=jobs, source=given.source, json=given.json)
