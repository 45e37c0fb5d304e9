"""Access to a finished or unfinished run: its configuration, model, scene and rendered layers."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from torch import Tensor

from polarguide.capture import Scene, load_scene, read_model
from polarguide.capture.layout import find_layout
from polarguide.capture.presentation import Presentation, read_presentation
from polarguide.capture.scene import IN_MEMORY
from polarguide.capture.variants import mask_background, select_exposures
from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.options import DeviceName, PathLike, SceneOptions, check_choice
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.text import command
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import SceneFrame, scene_frame
from polarguide.methods import recipe_named
from polarguide.raster import choose_backend
from polarguide.runs.folder import CONFIGURATION, RunConfiguration, load_checkpoint, writing_to
from polarguide.runs.health import Health
from polarguide.runs.model import GaussianModel, Within
from polarguide.shading.result import LAYERS, POLARIZED, RenderResult, polarized_layers
from polarguide.training.context import TrainingContext
from polarguide.training.metals.observations import blended
from polarguide.training.metals.search import MetalSearch
from polarguide.training.recipe import Recipe, values_differ
from polarguide.training.settings import ResolvedSettings, TrainSettings

Opened = TypeVar("Opened", bound="OpenedRun")


class OpenedRun:
    """A trained run that renders layers of any view. Its scene is read on first use.

    Args:
        folder: folder of the run.
        configuration: record of the training.
        recipe: the method.
        model: the trained model.
        scene: the scene or its folder. None means the folder in the configuration.
        reporter: receives the progress of reading the scene.
    """

    def __init__(
        self,
        folder: Path,
        configuration: RunConfiguration,
        recipe: Recipe,
        model: GaussianModel,
        *,
        scene: Scene | PathLike | None = None,
        reporter: Reporter = SILENT,
    ) -> None:
        self.folder = folder
        self.configuration = configuration
        self.recipe = recipe
        self.model = model
        self._scene_source = scene
        self._reporter = reporter

    def __repr__(self) -> str:
        facts = f"{self.recipe.name}, {self.steps} steps, {self.model.size}"
        return f"<{type(self).__name__} {self.folder}: {facts}\n polarization: {self._evidence()}>"

    def _evidence(self) -> str:
        """Return ``polarization``, or a message if the record is damaged, because ``repr`` must not raise errors."""
        try:
            return self.polarization
        except PolarguideError as error:
            return f"not known ({error.where})"

    @classmethod
    def open(
        cls: type[Opened],
        folder: PathLike,
        *,
        recipe: Recipe | str | None = None,
        scene: Scene | PathLike | None = None,
        device: DeviceName = "auto",
        reporter: Reporter = SILENT,
    ) -> Opened:
        """Open a run folder, and warn if the shading of the recipe has changed since the training.

        Args:
            folder: folder of the run.
            recipe: the recipe of the training, or its name. It is needed only if the recipe is not built in.
            scene: the scene or its folder, which is needed only if the scene was moved. It is read on first use.
            device: device of the computation.
            reporter: receives the progress of long operations.

        Raises:
            PolarguideError: the folder is not a run, is damaged, or belongs to another version of polarguide.
        """
        folder = Path(folder)
        configuration = RunConfiguration.load(folder)
        method = recipe if isinstance(recipe, Recipe) else recipe_named(recipe or configuration.recipe)
        if method.name != configuration.recipe:
            expected = f"{configuration.recipe}, which {folder} was trained with"
            remedy = "Give that recipe."
            raise PolarguideError("recipe", expected=expected, found=method.name, remedy=remedy)
        backend = choose_backend(device, say=reporter.say)
        state = load_checkpoint(folder, method, backend.device)
        if values_differ(method.data()["shading"], configuration.recipe_data.get("shading", {})):
            _warn(
                f"{folder} was trained with other shading values of the recipe {method.name} than those of this "
                "version, which shades its pictures."
            )
        shading = replace(method.shading, refractive_index=configuration.settings.refractive_index)
        model = GaussianModel(state, shading, backend)
        return cls(folder, configuration, method, model, scene=scene, reporter=reporter)

    @classmethod
    def of(cls: type[Opened], run: OpenedRun) -> Opened:
        """Convert an opened run to this class. Both objects share the scene and the model."""
        scene = run._scene_source
        reporter = run._reporter
        return cls(run.folder, run.configuration, run.recipe, run.model, scene=scene, reporter=reporter)

    @property
    def steps(self) -> int:
        """Number of trained steps."""
        return self.model.steps

    @property
    def gaussians(self) -> dict[str, Tensor]:
        """Parameters of the Gaussians by name, such as ``means`` [N, 3]; do not change them."""
        gaussians = self.model.state.gaussians
        return {name: gaussians[name].detach() for name in gaussians.names}

    @property
    def health(self) -> Health | None:
        """Result of the check at the end of the training.

        The value is missing (None) if the training is unfinished, or if its version of polarguide had no such check.

        Raises:
            PolarguideError: ``health.json`` is invalid.
        """
        return Health.load(self.folder)

    @property
    def polarization(self) -> str:
        """Quality of the polarization data of most training views, as text.

        The text begins with ``measured``, ``fitted`` or ``none``, and lists exceptions. It is ``not recorded`` for a
        run without ``health``.
        """
        health = self.health
        return "not recorded" if health is None else health.polarization.text

    @property
    def light(self) -> dict[str, Tensor]:
        """Parameters of the learned light, such as raw ``texels`` [6, R, R, C]; empty for a recipe without light."""
        return {name: values.detach() for name, values in self.model.light.items()}

    @cached_property
    def scene(self) -> Scene:
        """The scene of the training, read on first use. A warning is given if it has changed since the training.

        Raises:
            PolarguideError: the scene was moved or deleted, cannot be read, or was read with different options in the
                training.
        """
        configuration = self.configuration
        scene = self._scene_source
        options = SceneOptions(configuration.downscale, configuration.transfer, split="every-8th")
        recorded = configuration.test_views
        if not isinstance(scene, Scene):
            folder = self._folder_to_read()
            scene = read_scene(folder, options, self._reporter, recorded)
        if (scene.downscale, scene.transfer) != (options.downscale, options.transfer):
            expected = (
                f"downscale {options.downscale}, transfer {options.transfer}, as {self.folder} was trained"
            )
            reading = f"downscale {scene.downscale}, transfer {scene.transfer}"
            raise PolarguideError(
                "scene", expected=expected, found=reading, remedy="Load it with these options."
            )
        if scene.digest != configuration.scene_digest:
            _warn(f"{scene.root} has changed since {self.folder} was trained on it.")
        if recorded != scene.test_names:
            names = {view.name for view in scene.views}
            scene = replace(scene, test_names=tuple(name for name in recorded if name in names))
        return trained_scene(scene, configuration.settings)

    @property
    def scene_folder(self) -> Path:
        """Folder of the scene: the specified folder, or else the folder at the time of the training."""
        source = self._scene_source
        return source.root if isinstance(source, Scene) else Path(source or self.configuration.scene)

    @property
    def scene_is_there(self) -> bool:
        """True if the scene is in memory or in its folder."""
        return self._holds_scene or self.scene_folder.is_dir()

    @property
    def new_place(self) -> str:
        """Advice for errors about a scene that was moved."""
        return (
            f"If it was moved, specify its place: {command('present', self.folder, '--scene', 'NEWPLACE')}."
        )

    def point_to(self, scene: PathLike) -> None:
        """Record the new folder of the scene in ``run.json``.

        Raises:
            PolarguideError: the folder contains no scene, or a scene other than the scene of the training.
        """
        moved = OpenedRun(self.folder, self.configuration, self.recipe, self.model, scene=scene)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PolarguideWarning)  # a changed scene raises an error here
            digest = moved.scene.digest
        if digest != self.configuration.scene_digest:
            raise PolarguideError(
                scene,
                expected=f"the scene that {self.folder} was trained on",
                found="another scene, or a changed one",
                remedy="Specify the folder of the unchanged scene.",
            )
        self.configuration = replace(self.configuration, scene=str(Path(scene).resolve()))
        with writing_to(self.folder):
            self.configuration.save(self.folder)
        self._scene_source = None

    @property
    def presentation(self) -> Presentation:
        """Presentation of the run, read from the current files.

        Values in ``presentation.json`` of the run take precedence over values in ``presentation.json`` of its scene.

        Raises:
            PolarguideError: a file is invalid.
        """
        return read_presentation(self.folder).over(read_presentation(self.scene_folder))

    @cached_property
    def camera_frame(self) -> SceneFrame:
        """Frame of the scene's cameras, with their up direction. Only poses are read, not pictures.

        Raises:
            PolarguideError: the scene does not exist any more, or its poses cannot be read.
        """
        return scene_frame([*self.poses.values()])

    @cached_property
    def poses(self) -> dict[str, Camera]:
        """Cameras of the scene's views by name. Only poses are read, not pictures.

        Raises:
            PolarguideError: the scene does not exist any more, or its poses cannot be read.
        """
        if self._holds_scene:
            return self.cameras
        folder = self._folder_to_read()
        model = read_model(folder)
        return {name: model.camera(name) for name in find_layout(folder).names}

    @property
    def has_masks(self) -> bool:
        """True if the scene has masks of the foreground.

        Raises:
            PolarguideError: the scene does not exist any more.
        """
        if self._holds_scene:
            return any(view.mask is not None for view in self.scene.views)
        return bool(find_layout(self._folder_to_read()).masks)

    @property
    def _holds_scene(self) -> bool:
        return "scene" in self.__dict__ or isinstance(self._scene_source, Scene)

    def _folder_to_read(self) -> Path:
        """Return ``scene_folder`` after a check that it exists.

        Raises:
            PolarguideError: the scene consists of arrays and has no folder, or the folder does not exist any more.
        """
        folder = self.scene_folder
        if self._scene_source is None and folder != IN_MEMORY and not folder.exists():
            raise PolarguideError(
                folder,
                expected=f"the scene of {self.folder} according to its {CONFIGURATION}",
                found="nothing",
                remedy=self.new_place,
            )
        if folder == IN_MEMORY:
            raise PolarguideError(
                "scene",
                expected=f"the scene of arrays that {self.folder} was trained on",
                found="none",
                remedy="Create it again, and pass it: polarguide.open_run(folder, scene=scene).",
            )
        return folder

    @property
    def frame(self) -> SceneFrame:
        """Frame of the scene: ``camera_frame``, with the up axis of the presentation if one is specified."""
        return self.presentation.upright(self.camera_frame)

    @property
    def cameras(self) -> dict[str, Camera]:
        """Cameras of the scene's views by name. The scene is read on first use."""
        return {view.name: view.camera for view in self.scene.views}

    @cached_property
    def _possible_metals(self) -> Tensor | None:
        """Mask [N] of dielectric Gaussians that may be metals, see ``MetalSearch.undecided``."""
        context = TrainingContext(self.scene, self.recipe, self.configuration.settings, self.model.backend)
        return MetalSearch(context).undecided(self.model.state)

    def undecided(self, camera: Camera) -> Tensor | None:
        """Render the share [H, W] of dielectric surfaces that may be metals.

        The first call measures all training views, so the scene is read. The result is None if the training did not
        search for metals, or if no view determines the Stokes vector.
        """
        possible = self._possible_metals
        if possible is None:
            return None
        return blended(self.model.state.gaussians, possible.float(), camera, self.model.backend.rasterize)

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the rendered layers, in the order of ``LAYERS`` and ``POLARIZED``."""
        return self.model.layers

    def result(
        self,
        camera: Camera | str,
        *,
        normals: bool = True,
        depth: bool = True,
        surface: bool = True,
        polarized: bool = False,
        within: Within | None = None,
    ) -> RenderResult:
        """Render a view, and return all layers as one typed record on the run's device.

        Args:
            camera: any camera, or the name of a view, for which the scene is read.
            normals, depth: True to render these layers even if the recipe does not need them.
            surface: True for normals and depth of the surface at the pixel's median depth. Otherwise both are blended,
                which is faster.
            polarized: True to predict Stokes vectors, if the model supports it.
            within: function that maps positions [N, 3] in the scene to a mask [N] of visible positions. None means all
                are visible.
        """
        chosen = self.scene.view(camera).camera if isinstance(camera, str) else camera
        result = self.model.render(chosen, normals=normals, depth=depth, surface=surface, within=within)
        stokes = self.model.stokes(result, chosen) if polarized else None
        return result if stokes is None else result.with_layers(**polarized_layers(stokes))

    def render(self, camera: Camera | str, layers: Iterable[str] = ("final",)) -> dict[str, Tensor]:
        """Render layers of a picture.

        Args:
            camera: any camera, or the name of a view, for which the scene is read.
            layers: names of layers, see the property ``layers``.

        Returns:
            The layers by name. Most layers are linear radiance [H, W, 3] on the scale of S0/2. Normals are [H, W, 3] in
            world axes and have any length. Strength, roughness, metalness, depth and alpha are [H, W]. Polarization is
            predicted: ``stokes`` is [3, H, W, 3] in the lens frame, as ``View.stokes`` measures it. ``dolp`` [H, W] in
            [0, 1] and ``aolp`` [H, W] in [0, pi) radians are computed from its luminance.

        Raises:
            PolarguideError: a layer is unknown, or this recipe does not render it.
        """
        names = checked_layers([layers] if isinstance(layers, str) else list(layers))
        geometry = {"normal", "depth"} & {*names}
        result = self.result(camera, surface=bool(geometry), polarized=not {*names}.isdisjoint(POLARIZED))
        return self.chosen_layers(result, names)

    def chosen_layers(self, result: RenderResult, names: Iterable[str]) -> dict[str, Tensor]:
        """Return layers of a picture by name.

        Raises:
            PolarguideError: this recipe does not render one of them.
        """
        names = list(names)
        absent = [name for name in names if name not in result.layers]
        if absent:
            raise PolarguideError(
                "layers",
                expected=f"layers of the recipe {self.recipe.name}",
                found=", ".join(absent),
                remedy="Leave these layers out.",
            )
        return {name: result.layers[name] for name in names}


def checked_layers(names: list[str]) -> list[str]:
    """Check the names of layers, and return them as a list.

    Raises:
        PolarguideError: a name is unknown, or the list is empty.
    """
    for name in names or ["none"]:
        check_choice("layers", name, (*LAYERS, *POLARIZED))
    return names


def read_scene(
    folder: PathLike,
    options: SceneOptions = SceneOptions(),
    reporter: Reporter = SILENT,
    test_views: tuple[str, ...] | None = None,
    *,
    hold: bool = True,
) -> Scene:
    """Load a scene with progress, and report its warnings.

    Args:
        folder: folder of the scene.
        options: options for reading the scene.
        reporter: receives progress.
        test_views, hold: arguments of ``load_scene``.

    Raises:
        PolarguideError: the scene cannot be read.
    """
    scene = load_scene(
        folder,
        downscale=options.downscale,
        transfer=options.transfer,
        memory=options.memory,
        split=options.split,
        test_views=test_views,
        hold=hold,
        reporter=reporter,
    )
    for warning in scene.warnings:
        reporter.warn(warning)
    return scene


def trained_scene(scene: Scene, settings: TrainSettings | ResolvedSettings) -> Scene:
    """Return a copy of the scene with the exposures and the background that the settings specify."""
    chosen = select_exposures(scene, settings.exposures)
    return mask_background(chosen) if settings.background == "masked" else chosen


def _warn(text: str) -> None:
    """Issue a warning that points to the code that called this package."""
    warnings.warn(text, PolarguideWarning, stacklevel=4)
