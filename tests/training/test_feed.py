"""What a training keeps of its views, and the sizes in which it looks at them: the same bits wherever it stops."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from trainings import different, make_trainer, run, trained

from polarguide.capture import Scene
from polarguide.methods import RECIPES
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.training import storage
from polarguide.training.feed import (
    Feed,
    coarse_steps,
    is_complete,
    pack_priors,
    unpack_priors,
)
from polarguide.training.priors import view_priors
from polarguide.training.recipe import Coarse, Recipe, Weights
from polarguide.training.storage import Entry, Packed, ViewStore, packed, stored_values
from polarguide.training.targets import StepTargets

STEPS, STOP = 24, 13


def entry_of(seed: int, count: int = 1000) -> Entry:
    values = torch.randn(count, generator=torch.Generator().manual_seed(seed))
    return {"a": packed(values), "b": Packed(values > 0), "c": Packed(values[:7].double())}


def same(a: Entry, b: Entry) -> bool:
    return a.keys() == b.keys() and all(
        torch.equal(stored_values(a[name]), stored_values(b[name])) for name in a
    )


def fetched(store: ViewStore, view: str, make: Callable[[], Entry], *, disposable: bool = False) -> Entry:
    """The stored entry of a view, made and stored if it is missing."""
    entry = store.get("kind", view)
    if entry is None:
        entry = make()
        store.keep("kind", view, entry, disposable=disposable)
    return entry


def test_what_a_training_keeps_where_does_not_change_its_bits(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path
) -> None:
    whole = ViewStore()
    expected = trained(tiny_scene, busy_recipe, 60, until=STEPS, store=whole)
    assert whole.in_memory
    assert whole.in_file == 0
    for limit, folder in ((0, tmp_path), (whole.in_memory // 2, tmp_path), (0, None)):
        store = ViewStore(limit, folder)
        assert different(expected, trained(tiny_scene, busy_recipe, 60, until=STEPS, store=store)) == [], (
            limit
        )
        assert store.in_memory <= limit
        assert (store.in_file > 0) == (folder is not None)
        assert not list(tmp_path.iterdir()), "the file has no name"
        store.close()


def test_a_training_goes_on_with_another_store_to_the_same_bits(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path
) -> None:
    begun = make_trainer(tiny_scene, busy_recipe, 60)
    run(begun, STOP)
    store = ViewStore(3000, tmp_path)
    rest = trained(tiny_scene, busy_recipe, 60, until=STEPS, state=begun.state, store=store)
    assert different(rest, trained(tiny_scene, busy_recipe, 60, until=STEPS)) == []


def test_entries_come_back_from_memory_and_file(tmp_path: Path) -> None:
    made = []

    def maker(seed: int) -> Callable[[], Entry]:
        return lambda: made.append(seed) or entry_of(seed)  # type: ignore[func-returns-value]

    store = ViewStore(4000, tmp_path)
    for _ in range(3):
        for seed in range(4):
            assert same(fetched(store, f"v{seed}", maker(seed)), entry_of(seed))
    assert made == [0, 1, 2, 3]
    assert 0 < store.in_memory <= 4000
    length = store.in_file
    store.drop("kind")
    assert store.in_memory == 0
    for seed in range(4):
        fetched(store, f"v{seed}", maker(seed + 10))
    assert made[4:] == [10, 11, 12, 13]
    assert store.in_file == length, "places are used again"
    assert same(fetched(store, "v3", maker(0)), entry_of(13))
    store.drop("kind", "v3")
    assert same(fetched(store, "v3", maker(20)), entry_of(20))


def test_a_new_entry_replaces_the_old_one(tmp_path: Path) -> None:
    for store in (ViewStore(), ViewStore(0, tmp_path)):
        assert store.get("kind", "v") is None
        store.keep("kind", "v", entry_of(0))
        sizes = (store.in_memory, store.in_file)
        store.keep("kind", "v", entry_of(1))
        assert (store.in_memory, store.in_file) == sizes
        replaced = store.get("kind", "v")
        assert replaced is not None
        assert same(replaced, entry_of(1))


def test_what_can_be_had_cheaply_is_not_put_into_the_file(tmp_path: Path) -> None:
    store, made = ViewStore(0, tmp_path), []
    for _ in range(2):
        fetched(store, "v", lambda: made.append(0) or entry_of(0), disposable=True)  # type: ignore[func-returns-value]
    assert len(made) == 2
    assert store.in_file == 0


def test_a_disk_without_room_is_said_once_and_costs_only_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(storage.tempfile, "TemporaryFile", full)
    said: list[str] = []
    store = ViewStore(0, tmp_path, said.append)
    for seed in (0, 1, 0):
        assert same(fetched(store, f"v{seed}", lambda seed=seed: entry_of(seed)), entry_of(seed))
    (warning,) = said
    assert "No space left on device" in warning


def test_a_file_that_was_cut_is_made_again(tmp_path: Path) -> None:
    store = ViewStore(0, tmp_path)
    for seed in range(2):
        fetched(store, f"v{seed}", lambda seed=seed: entry_of(seed))
    store._file.truncate(100)
    assert same(fetched(store, "v1", lambda: entry_of(1)), entry_of(1))


@pytest.mark.parametrize("scale", [1.0, 0.3, 40.0])
def test_coding_keeps_zero_and_the_largest_and_rounds_the_rest(scale: float) -> None:
    values = scale * torch.linspace(-1, 1, 4001)
    found = stored_values(packed(values))
    assert float((found - values).abs().max()) <= scale * 0.51 / 32767
    assert float(found[2000]) == 0
    assert float(found[-1]) == pytest.approx(scale, rel=1e-7)
    for exact in (torch.zeros(5), torch.tensor([0.0, 1.0, 1.0])):
        assert torch.equal(stored_values(packed(exact)), exact)


def test_terms_find_what_they_read_of_the_priors(tiny_scene: Scene) -> None:
    view, recipe = tiny_scene.train_views[0], RECIPES["polarguide-stokes"]
    guide = -view.camera.world_rays()
    priors = view_priors(view, guide, recipe.priors, 1.5)
    fields = recipe.stages[1].weights.fields_read
    entry = pack_priors(priors, fields)
    assert is_complete(entry, fields)
    assert not is_complete(entry, Weights(normal=1.0).fields_read)
    found = unpack_priors(entry, view.camera, recipe.priors)
    for name in fields:
        expected, values = getattr(priors, name), getattr(found, name)
        if name == "stokes":
            expected, values = expected[1:], values[1:]
        assert float((expected - values).abs().max()) <= 0.51 / 32767 * max(1, float(expected.abs().max()))
    assert bool(found.normal.isnan().all()), "nothing reads it, so that nothing is there to be read"
    pixels = view.camera.width * view.camera.height
    assert sum(part.bytes for part in entry.values()) == 46 * pixels


STOKES = RECIPES["polarguide-stokes"]
ALL_STEPS = 40
HALVED = dataclasses.replace(STOKES, coarse=Coarse(share=0.5, factor=2, pixels=1))
NEVER = dataclasses.replace(STOKES, coarse=Coarse(share=0.0))


def test_the_first_half_of_the_steps_looks_at_smaller_pictures(
    tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, ...]] = []
    targets = Feed.targets

    def watched(self: Feed, *given: Any) -> StepTargets:
        found = targets(self, *given)
        seen.append(tuple(found.picture.shape[:2]))
        return found

    monkeypatch.setattr(Feed, "targets", watched)
    trained(tiny_scene, HALVED, ALL_STEPS)
    height, width = tiny_scene.train_views[0].codes.shape[1:3]
    assert seen == [(height // 2, width // 2)] * (ALL_STEPS // 2) + [(height, width)] * (ALL_STEPS // 2)


def test_what_was_kept_of_smaller_pictures_goes(tiny_scene: Scene) -> None:
    store = ViewStore()
    trainer = make_trainer(tiny_scene, HALVED, ALL_STEPS, store=store)
    run(trainer, ALL_STEPS // 2)
    kinds = {kind for kind, _ in store._entries}
    assert {"small photograph", "small priors"} <= kinds
    run(trainer)
    kinds = {kind for kind, _ in store._entries}
    assert not any(kind.startswith("small") for kind in kinds)
    assert {"photograph", "priors"} <= kinds


def test_going_on_gives_the_same_bits(tiny_scene: Scene, tmp_path: Path) -> None:
    """From before, at and after the step from which pictures are whole."""
    whole = make_trainer(tiny_scene, HALVED, ALL_STEPS)
    for stop in (13, 20, 27):
        run(whole, stop)
        (tmp_path / str(stop)).mkdir()
        save_checkpoint(tmp_path / str(stop), whole.state)
    run(whole)
    for stop in (13, 20, 27):
        state = load_checkpoint(tmp_path / str(stop), HALVED)
        resumed = trained(tiny_scene, HALVED, ALL_STEPS, state=state)
        assert different(resumed, whole.state.tensors()) == [], stop


def test_small_pictures_are_looked_at_whole(tiny_scene: Scene) -> None:
    assert coarse_steps(STOKES, tiny_scene.train_views, 5000) == 0
    assert coarse_steps(HALVED, tiny_scene.train_views, 5000) == 2500
    assert different(trained(tiny_scene, STOKES, ALL_STEPS), trained(tiny_scene, NEVER, ALL_STEPS)) == []
