"""How good a trained scene is: metrics, their one table, and the record of a run."""

from polarguide.evaluation.record import read_metrics, validate_metrics, write_metrics
from polarguide.evaluation.scores import ViewScores, score_view, summarize
from polarguide.evaluation.target import ViewTarget

__all__ = [
    "ViewScores",
    "ViewTarget",
    "read_metrics",
    "score_view",
    "summarize",
    "validate_metrics",
    "write_metrics",
]
