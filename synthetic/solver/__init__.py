"""Buoyant, incompressible smoke on a staggered grid: the truth of the benchmark. Runs in the backend's environment."""
