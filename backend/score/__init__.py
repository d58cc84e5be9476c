"""Scores against truth. Nothing here is read by a fit."""
