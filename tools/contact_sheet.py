"""One picture of the benchmark: a row for each scene of the set that ships, from its own files.

    python -m tools.contact_sheet [--from synthetic/bench] [--to docs/images/benchmark.png]

Columns: the clip's first, middle and last seen frame; the smoke alone at the last of them; the same moment from the first
frame's place, from the side and from behind.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import av
import cv2
import numpy as np

from backend.io.atomic import whole_file

_CHECKOUT = Path(__file__).resolve().parents[1]
_GAP = 4  # px


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--from", dest="source", type=Path, default=_CHECKOUT / "synthetic" / "bench")
    parser.add_argument("--to", type=Path, default=_CHECKOUT / "docs" / "images" / "benchmark.png")
    given = parser.parse_args()
    scenes = sorted(path.parents[1] for path in given.source.glob("*/truth/truth.json"))
    if not scenes:
        raise SystemExit(f"There is no scene in {given.source}. Make one with `python3 wildsmoke.py synth ship`.")
    sheet = np.concatenate([row(scene) for scene in scenes])
    with whole_file(given.to) as part:
        part.write_bytes(cv2.imencode(".png", sheet)[1].tobytes())
    return 0


def row(scene: Path) -> np.ndarray:
    """[H, W, 3] uint8 BGR: the pictures of one scene side by side under its name."""
    truth = json.loads((scene / "truth" / "truth.json").read_text(encoding="utf-8"))
    clip = frames(scene / "input" / "clip.mp4")
    last = len(clip) - 1
    pictures = [clip[0], clip[last // 2], clip[last], frames(scene / "input" / "smoke.mkv")[last]]
    for view in ("nvs", "side", "back"):
        shown = truth["views"][view]
        index = int(np.argmin(np.abs(np.array(shown) - last)))
        pictures.append(frames(scene / "truth" / view / "smoke.mkv")[index])
    text = f"{scene.name}: clip at frames 0, {last // 2}, {last}; smoke alone at {last}: input, first place, side, back"
    return beside(pictures, text)


def beside(pictures: list[np.ndarray], text: str) -> np.ndarray:
    """[H, W, 3] uint8 BGR: pictures of one size, a fourth channel left out, side by side under a line of text."""
    gap = np.zeros((pictures[0].shape[0], _GAP, 3), np.uint8)
    line = np.concatenate([part for picture in pictures for part in (picture[..., :3], gap)], axis=1)
    title = np.full((20, line.shape[1], 3), 30, np.uint8)
    cv2.putText(title, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (230, 230, 230), 1, cv2.LINE_AA)
    return np.concatenate([title, line])


def frames(path: Path) -> list[np.ndarray]:
    """All pictures of a video, uint8: BGR, or BGR on black and opacity."""
    with av.open(str(path)) as container:
        is_clear = container.streams.video[0].codec_context.pix_fmt == "bgra"
        return [frame.to_ndarray(format="bgra" if is_clear else "bgr24") for frame in container.decode(video=0)]


if __name__ == "__main__":
    raise SystemExit(main())
