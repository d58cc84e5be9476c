"""The options of what looks at the finished jobs of some scenes: which jobs, their scenes' truth, where figures go."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from backend.contract.result import RESULT_FILE
from backend.io.job_folder import JobFolder
from backend.io.particles import read_particles
from benchmarks.reconstruction import SETS


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """jobs: folders, each named after its scene; source: the folder of scenes; json: None where figures are printed only."""

    parser: argparse.ArgumentParser
    jobs: list[Path]
    source: Path
    json: Path | None

    def weights(self) -> str | None:
        """What the prior's weights of all jobs are known by, None without a prior. Ends the program where they are several."""
        found = {_weights_of(job) for job in self.jobs}
        if len(found) > 1:
            self.parser.error(
                f"The jobs in {self.jobs[0].parent} were fitted with different weights; fit them anew with one version."
            )
        return found.pop()


def read_options(arguments: Sequence[str] | None, *, description: str | None, scenes: str | None = None) -> Asked:
    """scenes: A,B, those that are looked at unless others are asked for; without it all that are there. Ends the program with a
    sentence where one is not finished."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=Path, required=True)
    parser.add_argument("--from", dest="source", type=Path, default=SETS)
    parser.add_argument("--scenes", default=scenes, help="A,B")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    there = sorted(path.parent.name for path in given.jobs.glob(f"*/{RESULT_FILE}"))
    asked = given.scenes.split(",") if given.scenes else there
    missing = [scene for scene in asked if scene not in there]
    if missing or not asked:
        what = f"no finished job of {', '.join(missing)}" if missing else "no finished job"
        parser.error(f"{given.jobs} holds {what}; run benchmarks.reconstruction first.")
    jobs = [given.jobs / scene for scene in asked]
    return Asked(parser=parser, jobs=jobs, source=given.source, json=given.json)


def _weights_of(job: Path) -> str | None:
    with read_particles(JobFolder(job).particles) as particles:
        mark = particles.info.provenance.get("prior_fingerprint")
    return mark and mark[:12]
