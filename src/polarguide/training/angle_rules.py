"""How polarizer angles are fitted and judged: every constant of the method, as data of the recipe."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AngleRules:
    """Constants of the search for unknown polarizer angles, and of the check of known ones.

    Attributes:
        search_steps: steps of the schedule on which unknown angles are sought before the training. Longer is not
            better: flat surfaces that mirror, such as water, bend to explain their reflections without polarization.
        search_size: pixels of the longer side of the pictures that are used for it, at most.
        first, every, last: shares of these steps at which angles are fitted; their mean counts. Earlier fits would
            confirm the initial guess, and later ones the errors that the model has absorbed meanwhile.
        again: shares at which they are fitted in a second search, which begins with the angles of the first: most are
            right, and predict better for the others. A third search found nothing more on two scenes.
        checks: shares of all steps at which known angles are compared with the pictures. Early, the model predicts
            little; late, colors and surfaces have bent to the given angles. Half size, 1,500 steps: of six wrong angles
            of 63 (45 or 90 degrees off), one, three and five contradict, five in all, and no right one.
        least_spread: degrees of spread under which a fit counts no more for having less.
        weak: modulation under which an angle is not relied on. Wrong predictions take some of it away: a picture
            through a filter seldom has all of it, and half is usual when angles are first fitted.
        vague: degrees of spread from which on a picture does not tell its angle.
        lost: degrees of spread from which on a fitted angle is not even the best guess. With up to 30 degrees of error
            such a guess is nearer than a photograph without a filter; spreads of 20 to 60 degrees had errors under 20,
            mostly.
        disagree: degrees of scatter of a picture's fits from which on they do not agree.
        contradicts: degrees between given and fitted angle from which on they contradict each other, if that is also
            three times the spread and three standard deviations of the deviations of all pictures. Rings are read to a
            few degrees.
        locked: standard deviation of the logarithms of fitted gains up to which exposures count as equal: the first fit
            has 0.03 to 0.07 for equal ones, and automatic exposure of 0.3 stops each way 0.13.
        fewest: pictures from which on a spread of gains is determined.
        poor: ``Judgment.unexplained`` from which on a picture may well be at another angle. On four test scenes, two
            seeds, every picture that was over 45 degrees off exceeded it, and at most five others of 63 did; it was set
            by one of these seeds.
    """

    search_steps: int = 900
    search_size: int = 160
    first: float = 0.5
    every: float = 0.05
    last: float = 0.65
    again: tuple[float, ...] = (0.5, 0.65, 0.8, 0.95)
    checks: tuple[float, ...] = (0.2, 0.3, 0.5)
    least_spread: float = 1.0
    weak: float = 0.22
    vague: float = 15.0
    lost: float = 45.0
    disagree: float = 10.0
    contradicts: float = 20.0
    locked: float = 0.1
    fewest: int = 4
    poor: float = 0.95
