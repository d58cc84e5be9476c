"""The fluid's sums as plain double loops over all pairs, float64: slow, and short enough to check against the papers."""

from __future__ import annotations

import math

import numpy as np


def poly6(distance: float, length: float) -> float:
    """Mueller 2003 eq. 20."""
    return 315.0 / (64.0 * math.pi * length**9) * (length**2 - distance**2) ** 3 if distance < length else 0.0


def spiky_gradient(offset: np.ndarray, length: float) -> np.ndarray:
    """Mueller 2003 eq. 21, by the position that the offset points at."""
    distance = math.sqrt(float(offset @ offset))
    if distance >= length or distance == 0.0:
        return np.zeros(3)
    return -45.0 / (math.pi * length**6) * (length - distance) ** 2 * offset / distance


def densities(positions: np.ndarray, length: float) -> np.ndarray:
    """Number density at each particle, 1/m^3."""
    return np.array([sum(poly6(float(np.linalg.norm(a - b)), length) for b in positions) for a in positions])


def lambdas(positions: np.ndarray, length: float, rest_density: float, epsilon: float) -> np.ndarray:
    """Macklin & Mueller 2013 eq. 11 for gas: under-dense particles have 0. m^2."""
    result = []
    for i, density in enumerate(densities(positions, length)):
        gradients = [spiky_gradient(positions[i] - other, length) / rest_density for other in positions]
        squares = sum(float(g @ g) for g in gradients) + float(sum(gradients) @ sum(gradients))
        result.append(-max(density / rest_density - 1.0, 0.0) / (squares + epsilon))
    return np.array(result)


def shifts(positions: np.ndarray, length: float, rest_density: float, multipliers: np.ndarray, tensile: float) -> np.ndarray:
    """Macklin & Mueller 2013 eq. 14 with the artificial pressure of eq. 13, exponent 4, distance 0.25 h. m."""
    result = np.zeros_like(positions)
    for i in range(len(positions)):
        for j in range(len(positions)):
            if i != j:
                offset = positions[i] - positions[j]
                share = poly6(float(np.linalg.norm(offset)), length) / poly6(0.25 * length, length)
                pressure = multipliers[i] + multipliers[j] - tensile * share**4
                result[i] += pressure * spiky_gradient(offset, length) / rest_density
    return result


def divergences(positions: np.ndarray, velocities: np.ndarray, radius: float, regularisation: float) -> np.ndarray:
    """WildSmoke supplement eq. 7 and 8 with sigma = r / 2 and an absolute lambda. 1/s."""
    result = []
    for i in range(len(positions)):
        near = [j for j in range(len(positions)) if j != i and np.linalg.norm(positions[j] - positions[i]) <= radius]
        a = np.array([positions[j] - positions[i] for j in near]).reshape(-1, 3)
        b = np.array([velocities[j] - velocities[i] for j in near]).reshape(-1, 3)
        w = np.diag([math.exp(-float(row @ row) / (2.0 * (0.5 * radius) ** 2)) for row in a]).reshape(len(near), len(near))
        result.append(float(np.trace(np.linalg.inv(a.T @ w @ a + regularisation * np.eye(3)) @ a.T @ w @ b)))
    return np.array(result)
