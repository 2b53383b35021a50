"""What is read for a picture, and the picture."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from PIL import Image
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import load_results

from agents import load_algorithm
from pipeline import curve_pictures
from pipeline.curve_pictures import draw_learning_curve, moving_average, read_monitors
from pipeline.evaluation.sampled import Yardstick
from pipeline.runs import Run


def write_monitor(folder, name, rows, start=1000.0):
    header = json.dumps({"t_start": start, "env_id": "FrozenLake-v1"})
    lines = [f"#{header}", "r,l,t", *(",".join(map(str, row)) for row in rows)]
    (folder / f"{name}.monitor.csv").write_text("\n".join(lines) + "\n")


# --- reading -------------------------------------------------------------------------------------


def test_the_episodes_of_several_environments_in_the_order_in_which_they_ended(tmp_path):
    # Three environments step together: the second one's first episode ends after 3 x 4 steps.
    write_monitor(tmp_path, 0, [(1, 10, 9.0), (2, 5, 9.5)])
    # Clocks do not count: processes start when they can.
    write_monitor(tmp_path, 1, [(3, 4, 0.1), (4, 8, 0.2)], start=2000.0)
    write_monitor(tmp_path, 2, [(5, 11, 50.0)], start=500.0)
    steps, returns = read_monitors(tmp_path)
    assert steps.tolist() == [12, 30, 33, 36, 45]
    assert returns.tolist() == [3, 1, 5, 4, 2]
    write_monitor(tmp_path, 3, [])  # it has stepped all the same
    assert read_monitors(tmp_path)[0].tolist() == [16, 40, 44, 48, 60]


@pytest.mark.parametrize("n_monitors", [0, 2])
def test_no_episode_yet(tmp_path, n_monitors):
    for n in range(n_monitors):
        write_monitor(tmp_path, n, [])
    steps, returns = read_monitors(tmp_path)
    assert steps.shape == returns.shape == (0,)


@pytest.mark.parametrize("n_envs", [1, 11])
def test_the_monitors_of_a_real_run(tmp_path, n_envs):
    """The steps are those that the algorithm counts; the rows are those that the library reads."""
    ended = []

    class Watch(BaseCallback):
        def _on_step(self):
            for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
                if done:
                    ended.append((self.num_timesteps, info["episode"]["r"]))
            return True

    env = make_vec_env("CartPole-v1", n_envs, seed=0, monitor_dir=str(tmp_path))
    load_algorithm("random")("RandomPolicy", env, seed=0).learn(1500, callback=Watch())
    env.close()
    steps, returns = read_monitors(tmp_path)
    # Episodes that end in the same step have no order.
    assert sorted(zip(steps, returns, strict=True)) == sorted(ended)
    assert (np.diff(steps) >= 0).all()
    assert sorted(returns) == sorted(load_results(str(tmp_path))["r"])


# --- moving averages -----------------------------------------------------------------------------


@given(
    npst.arrays(np.float64, st.integers(1, 50), elements=st.floats(-1000, 1000)),
    st.integers(1, 60),
)
def test_a_moving_average_is_a_convolution(values, width):
    averages = moving_average(values, width)
    assert averages.shape == values.shape
    # Where there are fewer values, it is the mean of all.
    counts = np.minimum(np.arange(1, len(values) + 1), width)
    expected = np.convolve(values, np.ones(width))[: len(values)] / counts
    np.testing.assert_allclose(averages, expected, rtol=1e-9, atol=1e-9)


# --- the picture ---------------------------------------------------------------------------------


@pytest.fixture
def run(tmp_path):
    return Run.claim(tmp_path, "qlearning", "FrozenLake-v1")


def picture(run, title="qlearning on FrozenLake-v1, seed 0"):
    draw_learning_curve(run, title)
    with Image.open(run.curve_path) as image:
        image.load()
        assert image.format == "PNG"
        return image.size, np.asarray(image.convert("RGB")).reshape(-1, 3)


def has_colour(pixels, colour):
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return bool((pixels == wanted).all(axis=1).any())


def write_evaluations(run, results):
    results = np.array(results, dtype=np.float64)
    steps = 1000 * np.arange(1, len(results) + 1)
    np.savez(run.evaluations_path, timesteps=steps, results=results, ep_lengths=results)


@pytest.mark.parametrize(("trained", "judged"), [(True, True), (True, False), (False, True)])
def test_the_picture_of_a_run(run, trained, judged):
    if trained:
        write_monitor(run.path, 0, [(r, 10, i) for i, r in enumerate(range(300))])
    if judged:
        write_evaluations(run, [[1.0, 2.0]])
    size, pixels = picture(run)
    assert size == (960, 540)
    assert has_colour(pixels, curve_pictures.ORANGE) == trained
    assert has_colour(pixels, curve_pictures.BLUE) == judged
    assert not list(run.path.glob(".*"))


@pytest.mark.parametrize("rows", [None, [], [(1.0, 3, 0.1)]])
def test_a_run_with_little_to_show_is_drawn_without_warnings(run, rows):
    if rows is not None:
        write_monitor(run.path, 0, rows)
    size, pixels = picture(run)
    assert size == (960, 540)
    assert not has_colour(pixels, curve_pictures.BLUE)


def test_the_legend_covers_nothing(run, monkeypatch):
    drawn = []
    monkeypatch.setattr("pipeline.curve_pictures.write_png", lambda figure, _: drawn.append(figure))
    write_monitor(run.path, 0, [(float(i), 10, i) for i in range(50)])
    write_evaluations(run, [[1.0], [2.0]])
    draw_learning_curve(run, "title", yardstick=Yardstick(optimum=50, baseline=0))
    (figure,) = drawn
    figure.draw_without_rendering()
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[3:] == ["optimum", "best random or constant policy"]
    box, (axes,) = legend.get_window_extent(), figure.axes
    assert not box.overlaps(axes.get_tightbbox())
    assert figure.bbox.x0 <= box.x0 <= box.x1 <= figure.bbox.x1
    assert figure.bbox.y0 <= box.y0


def axes_drawn(run, monkeypatch, judged=True, n_episodes=50, **options):
    """The axes of the picture, of a run with returns above its optimum, by their titles."""
    drawn = []
    monkeypatch.setattr("pipeline.curve_pictures.write_png", lambda figure, _: drawn.append(figure))
    write_monitor(run.path, 0, [(89.0, 10, i) for i in range(n_episodes)])
    if judged:
        write_evaluations(run, [[70.0], [79.0]])
    yardstick = Yardstick(optimum=79, baseline=0) if judged else None
    draw_learning_curve(run, "title", yardstick=yardstick, **options)
    return drawn[0].axes


def names_in(axes):
    return [line.get_label() for line in axes.get_lines() if line.get_label()[0] != "_"]


def test_training_on_a_variant_is_drawn_apart(run, monkeypatch):
    upper, lower = axes_drawn(run, monkeypatch, on_variant=True)
    judged = ["evaluation, mean return", "optimum", "best random or constant policy"]
    assert names_in(upper) == judged
    assert names_in(lower) == ["training, each episode", "training, mean of 50 episodes"]
    assert lower.get_title(loc="left") == "training, on a variant of the environment"
    assert upper.get_title(loc="left") == "title"
    # Steps go together, returns do not.
    assert upper.get_xlim() == lower.get_xlim()
    assert upper.get_ylim()[1] < 89 < lower.get_ylim()[1]


def test_training_on_the_environment_itself_is_drawn_with_the_evaluations(run, monkeypatch):
    (axes,) = axes_drawn(run, monkeypatch)
    drawn = ["training, each episode", "training, mean of 50 episodes"]
    drawn += ["evaluation, mean return", "optimum", "best random or constant policy"]
    assert names_in(axes) == drawn
    run.evaluations_path.unlink()
    (axes,) = axes_drawn(run, monkeypatch, judged=False, on_variant=True)
    on_variant = [name.replace("training", "training on a variant") for name in drawn[:2]]
    assert names_in(axes) == on_variant


def test_the_mean_is_of_as_many_episodes_as_there_are(run, monkeypatch):
    axes = axes_drawn(run, monkeypatch, n_episodes=1)[0]
    assert "training, each episode" in names_in(axes)
    assert not any("mean of" in name for name in names_in(axes))
    axes = axes_drawn(run, monkeypatch, n_episodes=200)[0]
    assert "training, mean of 100 episodes" in names_in(axes)
    monkeypatch.setattr(curve_pictures, "MAX_POINTS", 100)
    axes = axes_drawn(run, monkeypatch, n_episodes=200)[0]
    assert "training, 1 episode in 2" in names_in(axes)


def scale_of(returns):
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    curve_pictures._compress_outliers(axes, np.array(returns, dtype=np.float64))
    assert ("log beyond" in axes.get_ylabel()) == (axes.get_yscale() == "symlog")
    return axes.get_yscale()


@pytest.mark.parametrize(
    ("returns", "scale"),
    [
        ([], "linear"),
        ([0.0], "linear"),
        ([1.0, 500.0], "linear"),
        ([-790.0, 79.0, 79.0, 79.0], "linear"),
        ([-791.0, 79.0, 79.0, 79.0], "symlog"),
        ([0.0] * 8, "linear"),
        ([11.0, 0.0, 0.0, 0.0], "symlog"),
    ],
)
def test_early_returns_that_dwarf_the_last_are_compressed(returns, scale):
    assert scale_of(returns) == scale
