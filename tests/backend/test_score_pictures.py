"""What is measured of pictures besides PSNR: structure, change in time, motion, and a learned distance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.signal import correlate
from skimage.metrics import structural_similarity

from backend.contract.errors import BackendError
from backend.score.measures import Target
from backend.score.perceptual import read_perceptual
from backend.score.similarity import Moments, similarity, similarity_map
from backend.score.tally import Tally
from backend.score.temporal import Changes, FlowError


def pictures(seed: int, *, size: tuple[int, int] = (40, 56), noise: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Two that are alike, [H, W, 3] float32."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[: size[0], : size[1]]
    smooth = 0.5 + 0.4 * np.sin(rows / 5.0)[..., None] * np.cos(columns / np.array([3.0, 4.0, 7.0])[:, None, None]).transpose(
        1, 2, 0
    )
    other = smooth + noise * random.normal(size=smooth.shape)
    return np.clip(smooth, 0, 1).astype(np.float32), np.clip(other, 0, 1).astype(np.float32)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1, 1.0])
@pytest.mark.parametrize("size", [(11, 11), (12, 30), (40, 56)])
def test_ssim_is_that_of_scikit_image(size: tuple[int, int], noise: float) -> None:
    truth, ours = pictures(1, size=size, noise=noise)
    expected = structural_similarity(
        truth, ours, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2
    )
    found, _ = similarity(ours, Moments(truth), np.ones(size, bool))
    assert found == pytest.approx(expected, abs=2e-5)


def test_ssim_of_flat_pictures_by_hand() -> None:
    """Without variance only the first factor is left: (2 a b + C1) / (a^2 + b^2 + C1)."""
    a, b = np.full((20, 20, 3), 0.2, np.float32), np.full((20, 20, 3), 0.6, np.float32)
    expected = (2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4)
    assert similarity_map(b, Moments(a)) == pytest.approx(expected, rel=1e-3)
    assert similarity_map(0 * a, Moments(0 * a)) == pytest.approx(1.0)


def test_ssim_inside_a_mask_leaves_the_rest_out() -> None:
    truth, ours = pictures(2)
    mask = np.zeros(truth.shape[:2], bool)
    mask[:, :28] = True
    ours[:, 40:] = 0.0
    full, inside = similarity(ours, Moments(truth), mask)
    assert inside == pytest.approx(similarity_map(ours, Moments(truth))[:, :23].mean(), abs=1e-6) and full < inside - 0.1
    assert np.isnan(similarity(ours, Moments(truth), np.zeros_like(mask))[1])


def test_ssim_refuses_what_it_cannot_compare() -> None:
    truth, _ = pictures(3)
    with pytest.raises(ValueError, match="SSIM of"):
        similarity_map(truth[:-1], Moments(truth))
    with pytest.raises(ValueError, match="SSIM of"):
        similarity_map(truth[:10], Moments(truth[:10]))


def lit(coded_value: float, *, size: tuple[int, int] = (20, 24)) -> np.ndarray:
    """[H, W, 4] even smoke whose coded light is the value."""
    linear = ((coded_value + 0.055) / 1.055) ** 2.4
    return np.concatenate([np.full((*size, 3), linear), np.ones((*size, 1))], axis=2).astype(np.float32)


def test_changes_by_hand() -> None:
    """Truth grows by 0.1 a picture; ours by 0.3 and then by -0.1: errors 0.2 and 0.2, changes 0.1 of 0.2236 rms."""
    changes = Changes()
    for ours, real in ((0.2, 0.3), (0.5, 0.4), (0.4, 0.5)):
        changes.add(np.full((20, 24, 3), ours), Target(lit(real)))
    assert changes.dtssd == pytest.approx(0.2, rel=1e-4)
    assert changes.ratio == pytest.approx(np.sqrt((0.3**2 + 0.1**2) / 2) / 0.1, rel=1e-4)


def test_changes_of_too_few_pictures() -> None:
    changes = Changes()
    changes.add(np.zeros((20, 24, 3)), Target(lit(0.3)))
    assert np.isnan(changes.dtssd) and np.isnan(changes.ratio)
    changes.add(np.ones((20, 24, 3)), Target(lit(0.3)))
    assert changes.dtssd > 0.9 and np.isnan(changes.ratio), "nothing changes in the truth"


def drifting(columns: float, *, num: int = 4) -> list[np.ndarray]:
    """[H, W, 4] each: texture that moves to the right by some px a picture."""
    y, x = np.mgrid[0:64, 0:96]
    found = []
    for index in range(num):
        value = 0.3 + 0.2 * np.sin((x - columns * index) / 4.0) * np.cos(y / 5.0)
        found.append(np.repeat(value[..., None], 4, axis=2).astype(np.float32))
    return found


def test_the_error_of_flow() -> None:
    truth, ours = drifting(1.5), drifting(0.5)
    flow = FlowError(len(truth))
    same = FlowError(len(truth))
    for shown, real in zip(ours, truth, strict=True):
        target = Target(real)
        flow.add(Target(shown).coded, target)
        same.add(target.coded, target)
    assert same.summary()["tof"] == 0.0
    assert flow.summary()["tof"] == pytest.approx(1.0, abs=0.2) and flow.summary()["still"] == pytest.approx(1.5, abs=0.2)
    assert FlowError(3).summary() == {}


def test_a_tally_says_what_it_has() -> None:
    tally = Tally([0, 3])
    for frame, value in ((0, 0.4), (3, 0.5)):
        tally.add(frame, lit(value), Target(lit(0.5)))
    found = tally.summary(6)
    assert found["by_frame_db"] == {"0": pytest.approx(20.0, abs=1e-2), "3": 50.0}
    assert found["first_db"] == found["by_frame_db"]["0"] and found["middle_db"] == 50.0 and found["last_db"] is None
    assert found["by_frame_ssim"]["3"] == 1.0 and found["change_ratio"] is None and "lpips" not in found
    with pytest.raises(ValueError, match="of a truth"):
        Tally([0]).add(0, lit(0.5, size=(21, 24)), Target(lit(0.5)))


CONVOLUTIONS = {  # number in torchvision's AlexNet -> shape, stride, padding
    0: ((64, 3, 11, 11), 4, 2),
    3: ((192, 64, 5, 5), 1, 2),
    6: ((384, 192, 3, 3), 1, 1),
    8: ((256, 384, 3, 3), 1, 1),
    10: ((256, 256, 3, 3), 1, 1),
}


def weights(*, seed: int = 0) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Of the network and of the layers, under the names of torchvision and of the package lpips."""
    random = np.random.default_rng(seed)
    network, layers = {}, {}
    for layer, (number, (shape, _, _)) in enumerate(CONVOLUTIONS.items()):
        spread = np.sqrt(2.0 / np.prod(shape[1:]))
        network[f"features.{number}.weight"] = torch.tensor(spread * random.normal(size=shape), dtype=torch.float32)
        network[f"features.{number}.bias"] = torch.tensor(0.1 * random.normal(size=shape[0]), dtype=torch.float32)
        layers[f"lin{layer}.model.1.weight"] = torch.tensor(random.uniform(size=(1, shape[0], 1, 1)), dtype=torch.float32)
    return network, layers


def reference_features(picture: np.ndarray, network: dict[str, torch.Tensor]) -> list[np.ndarray]:
    """float64, channel by channel, as Krizhevsky's network with the pooling of torchvision."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    values = np.moveaxis((2.0 * picture.astype(np.float64) - 1.0 - shift) / scale, 2, 0)
    found = []
    for number, (shape, stride, padding) in CONVOLUTIONS.items():
        if number in (3, 6):
            height, width = ((side - 3) // 2 + 1 for side in values.shape[1:])
            shifted = [values[:, i : i + 2 * height - 1 : 2, j : j + 2 * width - 1 : 2] for i in range(3) for j in range(3)]
            values = np.max(shifted, axis=0)
        padded = np.pad(values, ((0, 0), (padding, padding), (padding, padding)))
        kernels = network[f"features.{number}.weight"].double().numpy()
        bias = network[f"features.{number}.bias"].double().numpy()
        rows = [correlate(padded, kernels[channel], mode="valid")[0, ::stride, ::stride] for channel in range(shape[0])]
        values = np.maximum(np.stack(rows) + bias[:, None, None], 0.0)
        found.append(values / (np.linalg.norm(values, axis=0) + 1e-10))
    return found


def test_lpips_is_its_formula(tmp_path: Path) -> None:
    network, layers = weights()
    torch.save(network, tmp_path / "network.pth")
    torch.save(layers, tmp_path / "layers.pth")
    perceptual = read_perceptual([tmp_path / "network.pth", tmp_path / "layers.pth"])
    truth, ours = pictures(4, size=(64, 68))
    expected = 0.0
    both = zip(reference_features(ours, network), reference_features(truth, network), strict=True)
    for layer, (first, second) in enumerate(both):
        weight = layers[f"lin{layer}.model.1.weight"].double().numpy().reshape(-1, 1, 1)
        expected += (weight * (first - second) ** 2).sum(axis=0).mean()
    assert (perceptual.name, perceptual.network) == ("lpips", "alex")
    assert perceptual.distance(ours, truth) == pytest.approx(expected, rel=1e-4) and expected > 0.1
    assert perceptual.distance(truth, truth) == 0.0
    with pytest.raises(BackendError, match="at least 64"):
        perceptual.distance(truth[:50], truth[:50])


def test_one_file_and_other_names(tmp_path: Path) -> None:
    """The package's own state_dict: the same distance; with blurs in it, the shift-tolerant one, which is another figure."""
    network, layers = weights()
    slices = {0: 1, 3: 2, 6: 3, 8: 4, 10: 5}
    whole = dict(layers)
    for name, value in network.items():
        number = int(name.split(".")[1])
        whole[f"net.slice{slices[number]}.{number}.{name.split('.')[2]}"] = value
    torch.save(whole, tmp_path / "lpips.pth")
    torch.save(network | layers, tmp_path / "both.pth")
    torch.save(whole | {"net.slice1.1.filt": torch.ones(64, 1, 3, 3)}, tmp_path / "tolerant.pth")
    truth, ours = pictures(5, size=(64, 64))
    plain, both, tolerant = (read_perceptual([tmp_path / f"{name}.pth"]) for name in ("lpips", "both", "tolerant"))
    assert plain.distance(ours, truth) == both.distance(ours, truth) > 0.0
    assert tolerant.name == "st_lpips" and tolerant.distance(ours, truth) > 0.0 == tolerant.distance(truth, truth)


def test_weights_that_are_none(tmp_path: Path) -> None:
    network, layers = weights()
    (tmp_path / "text.pth").write_text("no tensors")
    torch.save([1, 2], tmp_path / "list.pth")
    torch.save(layers, tmp_path / "layers.pth")
    for name in ("text.pth", "list.pth", "missing.pth"):
        with pytest.raises(BackendError, match=r"tensors that can be read|no state_dict"):
            read_perceptual([tmp_path / name])
    with pytest.raises(BackendError, match="hold 0 convolutions and 5 layers"):
        read_perceptual([tmp_path / "layers.pth"])
    del network["features.6.bias"]
    torch.save(network | layers, tmp_path / "half.pth")
    with pytest.raises(BackendError, match="no AlexNet"):
        read_perceptual([tmp_path / "half.pth"])


def test_a_tally_asks_the_network_about_a_few_frames(tmp_path: Path) -> None:
    network, layers = weights()
    torch.save(network | layers, tmp_path / "both.pth")
    perceptual = read_perceptual([tmp_path / "both.pth"])
    asked = []
    distance = perceptual.distance
    perceptual.distance = lambda shown, truth: asked.append(1) or distance(shown, truth)  # type: ignore[method-assign]
    tally = Tally(list(range(40)), perceptual=perceptual)
    for frame in range(40):
        tally.add(frame, lit(0.4, size=(64, 64)), Target(lit(0.5, size=(64, 64))))
    assert len(asked) == 8 and tally.summary(40)["lpips"] > 0.0
