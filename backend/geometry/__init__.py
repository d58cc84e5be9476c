"""Cameras and projections."""
