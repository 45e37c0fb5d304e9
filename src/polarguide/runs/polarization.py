"""What a run knows of polarization, in one word that goes with its pictures and pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec

from polarguide.angles.polarizers import Judgment
from polarguide.capture import View

Word = Literal["measured", "fitted", "none"]
Count = Annotated[int, msgspec.Meta(ge=0)]


@dataclass(frozen=True)
class Polarization:
    """How far the layers and normals of a run rest on polarization.

    Attributes:
        measured: training views whose pictures determine the Stokes vector of every pixel.
        fitted: training views with pictures at too few angles for that: the model was fitted to them.
        none: training views that tell the recipe nothing of polarization; there, layers and normals are its guess.
        pictures: pictures of the fitted views that the training judged. doubtful: those whose angle is in doubt.
    """

    measured: Count
    fitted: Count
    none: Count
    pictures: Count = 0
    doubtful: Count = 0

    @classmethod
    def of(
        cls, views: Sequence[View], judgments: Sequence[Judgment], *, measured: bool, fitted: bool
    ) -> Polarization:
        """Count the training views of a run.

        Args:
            views: with what is believed of their pictures. judgments: what the training says of these.
            measured, fitted: whether the recipe reads the polarization of views that determine it, and of others.
        """
        determined = {view.name for view in views if view.is_determined}
        single = [
            view.name
            for view in views
            if view.name not in determined and any(e.angle is not None for e in view.exposures)
        ]
        counts = (len(determined) if measured else 0, len(single) if fitted else 0)
        judged = [judgment for judgment in judgments if judgment.view in single]
        doubtful = sum(judgment.doubtful for judgment in judged)
        return cls(*counts, len(views) - sum(counts), len(judged), doubtful)

    @property
    def word(self) -> Word:
        """What holds for most of the training views; of two that hold for as many, the one that promises less."""
        counts: dict[Word, int] = {"none": self.none, "fitted": self.fitted, "measured": self.measured}
        return max(counts, key=lambda word: counts[word])

    @property
    def text(self) -> str:
        """The word, with the views that it does not hold for and the pictures that are in doubt."""
        doubts = f" ({self.doubtful} of {self.pictures} pictures doubtful)" if self.pictures else ""
        counts = {"measured": self.measured, "fitted": self.fitted, "none": self.none}
        more = {"measured": "", "fitted": doubts, "none": ""}
        total, others = sum(counts.values()), [w for w in counts if counts[w] and w != self.word]
        if not others:
            guess = " (layers and normals are a guess of the model)" if self.word == "none" else ""
            return f"{self.word}{more[self.word]}{guess}"
        first = f"{self.word} in {counts[self.word]} of {total} views{more[self.word]}"
        return ", ".join([first, *(f"{w} in {counts[w]}{more[w]}" for w in others)])
