"""Steps down a loss, and that the training of the large network goes on where it was interrupted."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from backend.prior.network import PlumeNet
from training import train
from training.learning import KernelMuon
from training.lessons import write_lessons


def kernel_of(seed: int) -> nn.Parameter:
    weights = torch.randn((8, 4, 3, 3, 3), generator=torch.Generator().manual_seed(seed))
    return nn.Parameter(weights.contiguous(memory_format=torch.channels_last_3d))


def test_kernels_step_in_all_directions_alike() -> None:
    """A gradient that is nearly all of one direction: the step has as much of the others, and goes down."""
    kernel, large, small = kernel_of(0), kernel_of(1).detach()[:1], kernel_of(2).detach()
    kernel.grad = torch.ones((8, 1, 1, 1, 1)) * 100 * large + small
    before = kernel.detach().clone()
    KernelMuon([kernel], lr=1e-3, weight_decay=0.0).step()
    change = (kernel.detach() - before).permute(0, 2, 3, 4, 1).reshape(8, -1)
    of_gradient, of_change = (torch.linalg.svdvals(each) for each in (kernel.grad.permute(0, 2, 3, 4, 1).reshape(8, -1), change))
    assert of_gradient[0] > 50 * of_gradient[1]
    assert of_change[0] < 3 * of_change[-1]
    assert float((kernel.grad * (kernel.detach() - before)).sum()) < 0.0
    assert change.square().mean().sqrt() == pytest.approx(0.2e-3, rel=0.3), "as large as AdamW's of this rate"


def test_a_kernel_that_lies_otherwise_in_memory_is_refused() -> None:
    """It would be stepped in a copy, and never learn."""
    with pytest.raises(RuntimeError):
        KernelMuon([nn.Parameter(torch.zeros((8, 4, 3, 3, 3)))], lr=1e-3, weight_decay=0.0)


def test_every_weight_has_one_optimiser() -> None:
    net = PlumeNet((8, 8, 8)).to(memory_format=torch.channels_last_3d)
    before = {name: each.detach().clone() for name, each in net.named_parameters()}
    for each in net.parameters():
        each.grad = torch.ones_like(each)
    muon, adam = train.optimisers_of(net, rate=1e-3)
    muon.step()
    by_muon = {name for name, each in net.named_parameters() if not torch.equal(each, before[name])}
    adam.step()
    by_both = {name for name, each in net.named_parameters() if not torch.equal(each, before[name])}
    assert by_muon and all(before[name].dim() == 5 for name in by_muon)
    assert by_both == set(before)
    assert sum(len(group["params"]) for group in adam.param_groups) == len(before) - len(by_muon)


def test_motion_counts_by_how_much_it_varies_along_its_axis() -> None:
    """Not by how fast the smoke is: half of what goes sideways missed is as bad as half of what goes up."""
    draw = torch.Generator().manual_seed(0)
    spread, usual = torch.tensor([1.0, 1.5, 6.0]), torch.tensor([0.0, 0.0, 20.0])
    density = torch.ones((2, 6, 6, 6))
    velocity = torch.randn((2, 3, 6, 6, 6), generator=draw) * spread[:, None, None, None] + usual[:, None, None, None]

    def lost(error: torch.Tensor) -> float:
        answer = density, velocity + error[:, None, None, None]
        return float(train.losses(lambda *_: (answer, answer), (None, density, velocity))[0])  # type: ignore[arg-type]

    by_axis = [lost(0.5 * spread * torch.eye(3)[axis]) for axis in range(3)]
    assert lost(torch.zeros(3)) == 0.0
    assert by_axis == pytest.approx([by_axis[2]] * 3, rel=0.15)
    assert lost(torch.full((3,), 0.5)) == pytest.approx(lost(torch.full((3,), -0.5)))


@pytest.mark.filterwarnings("ignore:Mean of empty slice")  # all of this plume moves alike
def test_an_interrupted_training_goes_on_to_the_same_weights(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lessons = tmp_path / "lessons"
    lessons.mkdir()
    write_lessons(folder, lessons / "0000.npz", seed=3, count=4)
    for number in range(1, 6):
        shutil.copy(lessons / "0000.npz", lessons / f"{number:04d}.npz")

    def run(out: str) -> bytes:
        assert train.main(["--lessons", str(lessons), "--out", str(tmp_path / out), "--passes", "2"]) == 0
        return (tmp_path / out / "plumes.npz").read_bytes()

    note = train.note

    def interrupt(folder: Path, line: dict[str, Any]) -> None:
        if line["passes"] == 2:
            raise KeyboardInterrupt
        note(folder, line)

    with monkeypatch.context() as patch:
        patch.setattr(train, "note", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run("interrupted")
    assert run("interrupted") == run("whole")
    assert len((tmp_path / "interrupted" / "log.jsonl").read_text(encoding="utf-8").splitlines()) == 2
