"""Pictures against those of tests/envs/pictures, which somebody has looked at.

A picture that has changed is written to the folder that the failure names: look at it, and if it is
right put it in the place of the old one.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from envs.bandits.bandit import Tally, render_chart
from envs.drawing import ChartRenderer, GridRenderer, Scene

PICTURES = Path(__file__).parent / "pictures"
# Another release of pygame may smooth edges and letters otherwise: that much is no change.
LEVELS, SHARE = 40, 0.0005


def map_scene() -> Scene:
    """Every thing there is on a map; a trail that bends; a power source that was collected."""
    return Scene(("SP#M", "...G", "M.P#"), 6, [(0, 1), (1, 5), (5, 6)], [1], 3)


def burst_scene() -> Scene:
    """A robot on the mine that it has driven down to."""
    return Scene(("S.", "M#"), 2, [(0, 2)], [], 1)


def coarse_scene() -> Scene:
    """A map whose cells are too small for shapes."""
    rows = ["." * 200 for _ in range(120)]
    rows[0] = "S" + "." * 99 + "P" * 50 + "M" * 50
    rows[60] = "." * 60 + "#" * 80 + "." * 60
    rows[119] = "." * 199 + "G"
    steps = [(i, i + 1) for i in range(40)] + [(40 + 200 * i, 240 + 200 * i) for i in range(30)]
    return Scene(tuple(rows), 40 + 200 * 30, steps, range(100, 125), 1)


def tally_of(n_contexts: int, n_arms: int) -> tuple[Tally, NDArray[np.float64]]:
    """A few pulls of some of the arms, and means on both sides of zero."""
    tally = Tally.empty(n_contexts, n_arms)
    for i in range(3 * n_arms):
        if i % n_arms != 1:
            tally.add(i % n_contexts, i % n_arms, 0.25 * (i % 7) - 0.5)
    return tally, np.linspace(-1, 2, n_contexts * n_arms).reshape(n_contexts, n_arms)


def drawn(name: str) -> NDArray[np.uint8]:
    match name:
        case "map" | "burst" | "coarse":
            scene = {"map": map_scene, "burst": burst_scene, "coarse": coarse_scene}[name]()
            return GridRenderer(scene.rows, 10, "a map").pixels(scene)
        case "arms":
            tally, means = tally_of(2, 9)
            return ChartRenderer(10, "arms").pixels(render_chart(tally, means, 1))
        case _:
            tally, _ = tally_of(1, 60)
            return ChartRenderer(10, "arms").pixels(render_chart(tally, None, 0))


@pytest.mark.parametrize("name", ["map", "burst", "coarse", "arms", "many_arms"])
def test_a_picture_is_as_it_was(name: str, tmp_path: Path) -> None:
    found = drawn(name)
    Image.fromarray(found).save(tmp_path / f"{name}.png", optimize=True)
    known = np.asarray(Image.open(PICTURES / f"{name}.png").convert("RGB"))
    assert found.shape == known.shape
    changed = (np.abs(found.astype(np.int64) - known) > LEVELS).any(axis=2)
    assert changed.mean() <= SHARE, f"{changed.mean():.2%} of {tmp_path}/{name}.png has changed"


def test_a_renderer_opens_a_window_again_after_it_was_closed() -> None:
    renderer, scene = (
        GridRenderer(("S.", ".G"), 1000, "a map"),
        Scene(("S.", ".G"), 0, [], [], None),
    )
    for _ in range(2):
        renderer.show(scene)
        renderer.close()
    renderer.close()
