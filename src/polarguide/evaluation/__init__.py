"""Metrics, records and figures: what a trained scene is worth, in numbers and to the eye."""

from polarguide.evaluation.record import validate_metrics, write_metrics
from polarguide.evaluation.scores import ViewScores, score_view, summarize
from polarguide.evaluation.target import ViewTarget

__all__ = ["ViewScores", "ViewTarget", "score_view", "summarize", "validate_metrics", "write_metrics"]
