"""Constants of the detection of metals and flat surfaces, and of the fit of polarizer angles: data of the recipe."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MetalRules:
    """The five constants of the energy whose minimum says what is metal (``training.metals.cut``).

    Attributes:
        prior: nats per view by which a metal has to be likelier than a dielectric.
        trust: nats that a single Gaussian's evidence counts at most: of 20 one may be wrong, whatever its evidence.
        likeness: nats that it costs if one of two neighbors that look alike is a metal and the other is none.
        tint: standard deviation of the logarithm of a surface's tint in the light that it mirrors, of which the mean
            light of the scene is known: a metal is hardly more deeply colored than gold.
        surface: nats that a metal surface that hangs together has to be worth.
    """

    prior: float = 0.45
    trust: float = 3.0
    likeness: float = 8.0
    tint: float = 0.3
    surface: float = 40.0


@dataclass(frozen=True)
class MetalViews:
    """Which measurements count in the search for metals, and how the first metals fix the light.

    Attributes:
        most_views: views that are looked at, evenly spread.
        least_share: a view counts if a Gaussian has at least this share of its largest blending weight in it.
        least_normal: length of a blended normal above which a pixel counts: shorter ones mix surfaces.
        cosines: of the zenith angle, between which a view counts: head-on nothing is polarized, and at grazing angles
            normals and reflectances are uncertain.
        dark: radiance (full scale is 1) that is added to the one that errors are relative to.
        reach: metals are looked for within this share of the cameras' distance from the middle of the points: what is
            farther away is behind the subject in views from the other side.
        contradicted: share of a view's labels from which on a warning says that other views contradict them.
        gain_views: views from which the gain of the light is taken when the first metals are found.
        gain_share: share of metal above which a pixel counts for it.
        gain_pixels: least share of the pixels that have to count.
        most_gain: the largest gain.
    """

    most_views: int = 32
    least_share: float = 0.3
    least_normal: float = 0.3
    cosines: tuple[float, float] = (0.25, 0.97)
    dark: float = 0.02
    reach: float = 0.5
    contradicted: float = 0.15
    gain_views: int = 10
    gain_share: float = 0.6
    gain_pixels: float = 0.003
    most_gain: float = 4.0


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


@dataclass(frozen=True)
class FlatRules:
    """Constants of the search for flat surfaces.

    Attributes:
        tries: pairs of pixels that propose a normal. samples: pixels that judge them, about.
        close: sine of the angle between a pixel's plane of incidence and the normal, up to which they agree.
        apart: sine of the angle between the directions of two pixels under which they propose nothing.
        least: share of a view that a flat surface covers at least: one normal explains up to a sixth of a curved one by
            chance.
        faint: DoLP from which on a pixel counts.
        slack: factor on Fresnel's DoLP, and what is added to it, beyond which a pixel contradicts.
        grazing: cosine between normal and ray under which a surface is not seen.
        window, most: side in pixels of the square around a pixel, and the share of it that has to agree.
        alike: degrees within which flat surfaces of different views are one.
        fewest, share: views, and share of the views, that have to show it.
    """

    tries: int = 400
    samples: int = 12_000
    close: float = 0.03
    apart: float = 0.03
    least: float = 0.25
    faint: float = 0.05
    slack: tuple[float, float] = (1.1, 0.02)
    grazing: float = 0.05
    window: int = 9
    most: float = 0.7
    alike: float = 5.0
    fewest: int = 3
    share: float = 1 / 3
