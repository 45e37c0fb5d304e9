"""Constants of the detection of metals and flat surfaces, and of the fit of polarizer angles, as data of a recipe."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MetalRules:
    """Constants of the energy whose minimum decides on metals (``training.metals.cut``).

    Attributes:
        prior: log likelihood ratio per view, in nats, by which a metal must be likelier than a dielectric.
        trust: upper bound of the evidence of a single Gaussian, in nats: one of 20 may be wrong at any evidence.
        likeness: cost, in nats, of two similar neighbors of which one is a metal and the other a dielectric.
        tint: standard deviation of the logarithm of a surface's tint relative to the mean light of the scene. Metals
            are hardly more deeply colored than gold.
        surface: least gain of a connected metal surface, in nats.
    """

    prior: float = 0.45
    trust: float = 3.0
    likeness: float = 8.0
    tint: float = 0.3
    surface: float = 40.0


@dataclass(frozen=True)
class MetalViews:
    """Constants of the measurements for the search for metals, and of the light gain from the first metals.

    Attributes:
        most_views: largest number of examined views, evenly spread.
        least_share: a view counts if a Gaussian has at least this share of its largest blending weight in it.
        least_normal: length of a blended normal above which a pixel counts; shorter ones mix surfaces.
        cosines: cosines of the zenith angle between which a view counts. Light is unpolarized at normal incidence, and
            normals and reflectances are uncertain at grazing angles.
        dark: radiance (full scale is 1) that is added to the reference of relative errors.
        reach: share of the cameras' distance from the middle of the points within which metals are searched. Gaussians
            farther away are behind the subject in views from the other side.
        contradicted: share of the labels of a view above which contradictions by other views lead to a warning.
        gain_views: number of views for the gain of the light.
        gain_share: metal share above which a pixel counts for the gain.
        gain_pixels: least share of counted pixels.
        most_gain: largest gain.
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
        search_steps: steps of the schedule of a search before the training. More steps are not better: mirroring flat
            surfaces, such as water, bend to explain their reflections without polarization.
        search_size: largest number of pixels of the longer side of its pictures.
        first, every, last: shares of these steps at which angles are fitted; their mean counts. Earlier fits would
            confirm the initial guess, and later ones the errors that the model has absorbed by then.
        again: shares of the fits of a second search, which begins with the angles of the first. Most of these are right
            and improve the prediction for the others. A third search found no more on two scenes.
        checks: shares of all steps at which known angles are compared with the pictures. Early, the model predicts
            little; late, colors and surfaces have adapted to wrong angles. At half size and 1,500 steps, six of 63
            angles were wrong by 45 or 90 degrees: one, three and five of them contradict, five in all, and no right
            one.
        least_spread: spread in degrees below which a fit gains no more weight.
        weak: modulation below which an angle is unreliable. Wrong predictions reduce the modulation: pictures through a
            filter seldom have all of it, and half is usual at the first fits.
        vague: spread in degrees above which a picture does not determine its angle.
        lost: spread in degrees above which an angle is no best guess. Guesses with up to 30 degrees of error are better
            than a photograph without a filter; spreads of 20 to 60 degrees mostly had errors under 20.
        disagree: scatter in degrees above which the fits of a picture disagree.
        contradicts: degrees between specified and fitted angle above which they contradict each other, if that also
            exceeds three times the spread and three standard deviations of the deviations of all pictures. Angles are
            read from rings to a few degrees.
        locked: standard deviation of the logarithms of fitted gains up to which exposures count as equal: 0.03 to 0.07
            for equal exposures at the first fit, and 0.13 for automatic exposure within 0.3 stops.
        fewest: number of pictures that determine a spread of gains.
        poor: ``Judgment.unexplained`` above which a picture may be at another angle. On four test scenes and two seeds,
            every picture with an error over 45 degrees exceeded it, and at most five others of 63. It was chosen with
            one of these seeds.
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
        tries: number of pixel pairs that propose a normal.
        samples: approximate number of pixels that judge them.
        close: sine of the angle between the plane of incidence of a pixel and the normal up to which they agree.
        apart: sine of the angle between the directions of two pixels below which they propose no normal.
        least: least share of a view that a flat surface covers. One normal explains up to a sixth of a curved surface
            by chance.
        faint: DoLP above which a pixel counts.
        slack: factor on Fresnel's DoLP, and addition to it, beyond which a pixel contradicts.
        grazing: cosine between normal and ray below which a surface is not visible.
        window: side in pixels of the square around a pixel for ``most``.
        most: least share of that square that agrees.
        alike: degrees up to which flat surfaces of different views are the same.
        fewest, share: least number and least share of the views that show the surface.
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
