"""How hypothesis draws inputs here: the same ones in every run, few enough for every commit."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

same_draws = settings(deadline=None, derandomize=True, database=None, max_examples=40, suppress_health_check=list(HealthCheck))
