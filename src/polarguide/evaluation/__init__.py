"""Metrics, records and figures: what a trained scene is worth, in numbers and to the eye."""

from .record import validate_metrics, write_metrics
from .scores import ViewScores, score_view, summarise
from .target import ViewTarget

__all__ = ["ViewScores", "ViewTarget", "score_view", "summarise", "validate_metrics", "write_metrics"]
