"""What inspect says about clips whose nature is known."""

from __future__ import annotations

import json

import av
import numpy as np
import pytest

from backend.contract.errors import BackendError
from backend.contract.job import Config, override
from backend.io.images import encode_srgb
from backend.io.video import open_clip
from backend.stages import inspect

H, W = 90, 160


def write_clip(path, images) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=24, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = W, H, "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(encode_srgb(image.astype(np.float32)), format="rgb24")))
        container.mux(stream.encode())


def puffs(*, color, grows: bool, peak: float) -> list[np.ndarray]:
    y, x = np.mgrid[0:H, 0:W]
    images = []
    for k in range(24):
        size = 10 + grows * 0.8 * k
        opacity = np.clip(peak * 1.6 * np.exp(-((x - 80) ** 2 + (y - 50) ** 2) / size**2), 0, 1)
        images.append(opacity[..., None] * np.array(color) * (1 + 0.05 * np.sin(k + x / 3.0))[..., None])
    return images


def decide(path, **settings) -> dict[str, inspect.Decision]:
    with open_clip(path) as clip:
        decisions = inspect.inspect(clip, override(Config(), {k.replace("__", "."): v for k, v in settings.items()}))
    text, data = inspect.to_text(decisions), json.loads(inspect.to_json(decisions))
    assert [d["name"] for d in data["decisions"]] == [d.name for d in decisions]
    assert all(d.name in text and d.reason in text and d.reason.endswith(".") for d in decisions)
    return {d.name: d for d in decisions}


def test_grey_growing_smoke_on_black(tmp_path) -> None:
    write_clip(tmp_path / "a.mp4", puffs(color=[0.6, 0.6, 0.6], grows=True, peak=3.0))
    found = decide(tmp_path / "a.mp4", frames__working_size=80)
    values = {name: d.value for name, d in found.items()}
    assert values["extraction"] == "on_black" and values["camera"] == "still"
    assert values["color"] == "grey" and values["change"] == "evolving" and values["resolution"] == "80 x 45"
    assert values["density"] == "dense"
    assert found["change"].measured["growth"] > 1.5
    assert 64 <= values["visual particles"] <= Config().visual.num_particles


def test_coloured_steady_smoke(tmp_path) -> None:
    write_clip(tmp_path / "a.mp4", puffs(color=[0.7, 0.3, 0.15], grows=False, peak=0.6))
    found = decide(tmp_path / "a.mp4")
    assert found["color"].value == "coloured" and found["change"].value == "quasi-steady"
    assert found["resolution"].value == f"{W} x {H}"


def test_clip_without_smoke_is_refused(tmp_path) -> None:
    write_clip(tmp_path / "a.mp4", [np.zeros((H, W, 3))] * 8)
    with pytest.raises(BackendError) as caught:
        decide(tmp_path / "a.mp4")
    assert caught.value.code == "no_smoke"
