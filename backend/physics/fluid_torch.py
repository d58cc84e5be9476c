"""The step of fluid.py and solver.py in plain torch: the same formulas to read, for any device and dtype, and to test against.

Pairs are found anew for every pass, so there is nothing that could be out of date. Units and symbols as in
projection.py: positions x [h], motion u [h per substep], number density [1/h^3].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from .colliders import Collider, HalfSpace, Sphere
from .kernels import POLY6, SPIKY_SLOPE, SPIKY_SQUARED_GRADIENT
from .projection import COINCIDENT, separation
from .solver import EPSILON_SHARE, MAX_SHIFT, MAX_TRAVEL, RELAXATION
from .state import FluidParameters

_BLOCK = 1024  # rows of the distance table that are held at a time


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairs:
    """Both directions of every pair closer than h: sums over `second` belong to `first`."""

    first: Tensor  # [P] int64
    second: Tensor  # [P] int64
    offsets: Tensor  # [P, 3] h, from second to first
    squared: Tensor  # [P] h^2, at least COINCIDENT^2

    @property
    def poly6(self) -> Tensor:  # [P] 1/h^3
        return POLY6 * (1.0 - self.squared).clamp(min=0.0) ** 3

    @property
    def spiky_slope(self) -> Tensor:  # [P] 1/h^4, never positive
        return -SPIKY_SLOPE * (1.0 - self.squared.sqrt()).clamp(min=0.0) ** 2

    @property
    def spiky_gradient(self) -> Tensor:  # [P, 3] 1/h^4, by the position of first
        return (self.spiky_slope / self.squared.sqrt())[:, None] * self.offsets

    def total(self, values: Tensor, num: int) -> Tensor:
        """Sums [P, ...] over the neighbours of each of `num` particles."""
        return torch.zeros((num, *values.shape[1:]), dtype=values.dtype, device=values.device).index_add(0, self.first, values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Air:
    """What surrounds the particles, as tensors that may ask for gradients."""

    buoyancy: Tensor  # [3] m/s^2
    wind: Tensor  # [3] m/s
    drag: Tensor  # [] 1/s


def find_pairs(
    positions: Tensor,  # [N, 3] h
) -> Pairs:
    """All pairs closer than one smoothing length, by comparing every particle with every other."""
    firsts, seconds = [], []
    for start in range(0, len(positions), _BLOCK):
        offsets = positions[start : start + _BLOCK, None, :] - positions[None, :, :]
        first, second = torch.nonzero((offsets**2).sum(dim=2) < 1.0, as_tuple=True)
        is_pair = first + start != second
        firsts.append(first[is_pair] + start)
        seconds.append(second[is_pair])
    empty = torch.zeros(0, dtype=torch.int64, device=positions.device)
    first, second = torch.cat([empty, *firsts]), torch.cat([empty, *seconds])
    offsets = positions[first] - positions[second]
    squared = (offsets**2).sum(dim=1).clamp(min=COINCIDENT**2)
    return Pairs(first=first, second=second, offsets=offsets, squared=squared)


def step_torch(
    positions: Tensor,  # [N, 3] m
    velocities: Tensor,  # [N, 3] m/s
    ids: Tensor,  # [N] int64
    parameters: FluidParameters,
    dt: float,  # s
    *,
    air: Air | None = None,  # in place of what the parameters say
) -> tuple[Tensor, Tensor]:  # [N, 3] m, [N, 3] m/s
    """Positions and velocities `dt` seconds later. Finite input is the caller's business.

    Differentiable by everything that is a tensor, on the side of each choice that was taken.
    """
    length, air = parameters.smoothing_length, air or _air_of(parameters, positions)
    pull = air.buoyancy + air.drag * air.wind
    after = (velocities + dt * pull) / (1.0 + air.drag * dt)
    fastest = max((float(v.detach().norm(dim=1).max()) for v in (velocities, after) if len(v)), default=0.0)
    wanted = math.ceil(fastest * (dt / (MAX_TRAVEL * length)) - 1e-9)
    substeps = min(max(1, wanted), parameters.max_substeps)
    seconds = dt / substeps
    x, u = positions / length, velocities * (seconds / length)
    for _ in range(substeps):
        u = (u + pull * seconds * (seconds / length)) / (1.0 + air.drag * seconds)
        speed = u.norm(dim=1, keepdim=True)
        u = torch.where(speed > MAX_TRAVEL * (1.0 + 1e-9), u * (MAX_TRAVEL / speed.clamp(min=MAX_TRAVEL)), u)
        x, u = _substep(x, u, ids, parameters, seconds, air.wind)
    return x * length, u * (length / seconds)


def _air_of(parameters: FluidParameters, like: Tensor) -> Air:
    drag = torch.tensor(parameters.drag, dtype=like.dtype, device=like.device)
    return Air(buoyancy=_vector(parameters.buoyancy, like), wind=_vector(parameters.wind, like), drag=drag)


def _vector(values: tuple[float, float, float], like: Tensor) -> Tensor:
    return torch.tensor(values, dtype=like.dtype, device=like.device)


def _substep(
    x: Tensor, u: Tensor, ids: Tensor, parameters: FluidParameters, seconds: float, wind: Tensor
) -> tuple[Tensor, Tensor]:
    """Positions and motion one substep on; u holds the forces already."""
    rest_density = parameters.rest_density * parameters.smoothing_length**3
    squares_at_rest = SPIKY_SQUARED_GRADIENT / rest_density
    x = _part_coincident(_pushed_out(x + u, parameters), ids)
    rates = _compression(x, u, rest_density).clamp(min=0.0)
    shares, total = torch.zeros_like(rates), torch.zeros_like(u)
    for iteration in range(parameters.solver_iterations):
        pairs = find_pairs(x)
        gradients = pairs.spiky_gradient / rest_density
        excess = _density(pairs, len(x)) / rest_density - 1.0
        own_gradient = pairs.total(gradients, len(x))
        squares = (own_gradient**2).sum(dim=1) + pairs.total((pairs.spiky_slope / rest_density) ** 2, len(x))
        active = excess if parameters.pulls_when_sparse else excess.clamp(min=0.0)
        lambdas = -active / (squares + EPSILON_SHARE * squares_at_rest)
        if iteration == 0:
            safe = torch.where(rates > 0.0, rates, 1.0)
            shares = torch.where(rates > 0.0, safe / torch.maximum(excess, safe), 0.0)
        shifts, impulses = _corrections(pairs, gradients, lambdas, shares, parameters, squares_at_rest)
        total = total + impulses
        x = _pushed_out(x + shifts, parameters)
    squared = (total**2).sum()
    kept = (-2.0 * (u * total).sum() / squared).clamp(0.0, 1.0) if float(squared.detach()) > 0.0 else 0.0
    u = _stirred(x, u + kept * total, parameters, seconds, wind)
    return x, _deflected(x, u, parameters)


def _part_coincident(x: Tensor, ids: Tensor) -> Tensor:
    pairs = find_pairs(x)
    is_coincident = (pairs.offsets**2).sum(dim=1) < COINCIDENT**2
    first, second = pairs.first[is_coincident].tolist(), pairs.second[is_coincident].tolist()
    parted = x.clone()
    for i, j in zip(first, second, strict=True):
        parted[i] += COINCIDENT * _vector(separation(int(ids[i]), int(ids[j])), x)
    return parted


def _density(pairs: Pairs, num: int) -> Tensor:  # [N] 1/h^3
    return POLY6 + pairs.total(pairs.poly6, num)


def _compression(x: Tensor, u: Tensor, rest_density: float) -> Tensor:  # [N]
    """dC/dt per substep: the poly6 gradient against the relative motion."""
    pairs = find_pairs(x)
    gradient = (-6.0 * POLY6 * (1.0 - pairs.squared).clamp(min=0.0) ** 2)[:, None] * pairs.offsets
    return pairs.total((gradient * (u[pairs.first] - u[pairs.second])).sum(dim=1), len(x)) / rest_density


def _corrections(
    pairs: Pairs,
    gradients: Tensor,  # [P, 3] of the constraint
    lambdas: Tensor,  # [N]
    shares: Tensor,  # [N]
    parameters: FluidParameters,
    squares_at_rest: float,
) -> tuple[Tensor, Tensor]:  # [N, 3], [N, 3]
    """Shifts and impulses, limited pair by pair and then all alike."""
    num = len(lambdas)
    tension = ((1.0 - pairs.squared).clamp(min=0.0) / (1.0 - 0.25**2)) ** (3 * parameters.tensile_exponent)
    tension = parameters.tensile_strength / squares_at_rest * tension
    pressure = (lambdas[pairs.first] + lambdas[pairs.second] - tension)[:, None] * gradients
    moving = lambdas * shares
    impulse = (moving[pairs.first] + moving[pairs.second])[:, None] * gradients
    shifts, impulses = pairs.total(pressure, num), pairs.total(impulse, num)
    lengths = RELAXATION * shifts.norm(dim=1)
    scale = RELAXATION
    if num and float(lengths.detach().max()) > MAX_SHIFT:
        factors = MAX_SHIFT / lengths.clamp(min=MAX_SHIFT)
        limit = torch.minimum(factors[pairs.first], factors[pairs.second])[:, None]
        shifts, impulses = pairs.total(limit * pressure, num), pairs.total(limit * impulse, num)
        scale = RELAXATION * MAX_SHIFT / (RELAXATION * shifts.norm(dim=1).max()).clamp(min=MAX_SHIFT)
    return scale * shifts, scale * impulses


def _stirred(x: Tensor, u: Tensor, parameters: FluidParameters, seconds: float, wind: Tensor) -> Tensor:
    """Drag at the surface, viscosity and vorticity confinement."""
    pairs, num = find_pairs(x), len(x)
    density = _density(pairs, num)
    if parameters.surface_drag > 0.0:
        exposed = (1.0 - density / (parameters.rest_density * parameters.smoothing_length**3)).clamp(min=0.0)
        drag = (parameters.surface_drag * seconds * exposed)[:, None]
        u = (u + drag * wind * (seconds / parameters.smoothing_length)) / (1.0 + drag)
    if parameters.viscosity > 0.0:
        weights = pairs.poly6 / torch.maximum(density[pairs.first], density[pairs.second])
        relative = u[pairs.second] - u[pairs.first]
        u = u - math.expm1(-parameters.viscosity * seconds) * pairs.total(weights[:, None] * relative, num)
    if parameters.vorticity_confinement > 0.0:
        gradients = pairs.spiky_gradient / density[pairs.first, None]
        curls = pairs.total(torch.linalg.cross(u[pairs.second] - u[pairs.first], -gradients), num)
        strength = curls.norm(dim=1)
        rise = pairs.total((strength[pairs.second] - strength[pairs.first])[:, None] * gradients, num)
        largest = strength.scatter_reduce(0, pairs.first, strength[pairs.second], "amax")
        length = ((rise**2).sum(dim=1) + 1e-12 * largest**2).sqrt()
        direction = rise / torch.where(length > 0.0, length, torch.ones_like(length))[:, None]
        u = u + min(parameters.vorticity_confinement * seconds, 1.0) * torch.linalg.cross(direction, curls)
    return u


def _pushed_out(x: Tensor, parameters: FluidParameters) -> Tensor:
    x = x * parameters.smoothing_length if parameters.colliders else x
    for collider in parameters.colliders:
        distances, normals = _distances(collider, x)
        x = x - distances.clamp(max=0.0)[:, None] * normals
    return x / parameters.smoothing_length if parameters.colliders else x


def _deflected(x: Tensor, u: Tensor, parameters: FluidParameters) -> Tensor:
    for collider in parameters.colliders:
        distances, normals = _distances(collider, x * parameters.smoothing_length)
        along = (u * normals).sum(dim=1)
        is_hit = (distances <= 1e-6 * parameters.smoothing_length) & (along < 0.0)
        u = torch.where(is_hit[:, None], (1.0 - collider.friction) * (u - along[:, None] * normals), u)
    return u


def _distances(collider: Collider, positions: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distances [N] m and normals [N, 3]. Differentiable for planes and balls; others count as flat."""
    if isinstance(collider, HalfSpace):
        normal = _vector(collider.normal, positions) / math.hypot(*collider.normal)
        return (positions - _vector(collider.point, positions)) @ normal, normal.expand_as(positions)
    if isinstance(collider, Sphere):
        offsets = positions - _vector(collider.center, positions)
        lengths = offsets.norm(dim=1)
        is_centre = (lengths < 1e-12 * collider.radius)[:, None]
        normals = torch.where(is_centre, _vector((0.0, 0.0, 1.0), positions), offsets / lengths.clamp(min=1e-300)[:, None])
        return lengths - collider.radius, normals
    found = collider.distances(positions.detach().cpu().numpy().astype(np.float64))
    distances, normals = (torch.as_tensor(np.array(a), dtype=positions.dtype, device=positions.device) for a in found)
    return distances + (normals * (positions - positions.detach())).sum(dim=1), normals
