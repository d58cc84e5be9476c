"""The command line of what judges plumes one by one: each is written as soon as it is judged, and not judged again."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from backend.contract.job import Config, preset_config
from backend.io.atomic import write_text
from backend.prior.predict import Prior
from backend.prior.weights import WEIGHTS, weights_fingerprint
from synthetic.progress import Progress
from training.library import Plume, read_plume


def judge_all(
    arguments: Sequence[str],
    judged: Callable[[Plume, Prior, Config], dict[str, Any]],
    *,
    description: str | None,
    label: str,
    chosen: Callable[[list[Path]], list[Path]] = lambda folders: folders,
) -> int:
    """judged: what the file says of a plume; label: of the progress; chosen: of all folders of plumes those to judge."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plumes", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    given = parser.parse_args(arguments)
    head = {"weights": weights_fingerprint(given.weights)[:12], "preset": given.preset}
    results: dict[str, Any] = {**head, "plumes": {}}
    if given.json.exists():
        results = json.loads(given.json.read_text(encoding="utf-8"))
        if {name: results.get(name) for name in head} != head:
            parser.error(f"{given.json} is of other weights or another preset; name another file.")
    prior, config = Prior(given.weights), preset_config(given.preset)
    folders = chosen(sorted(path.parent for path in given.plumes.glob("*/plume.json")))
    progress = Progress(label=label, total=len(folders))
    for folder in folders:
        plume = read_plume(folder)
        if plume.scene.name not in results["plumes"]:
            results["plumes"][plume.scene.name] = judged(plume, prior, config)
            write_text(given.json, json.dumps(results, indent=1) + "\n")
        progress.step()
    return 0
