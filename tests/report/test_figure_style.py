"""The look of every figure, and the ticks of a logarithmic axis."""

import pytest
from PIL import Image

from pipeline.curve_pictures import symlog_ticks
from report.figures import FigureFiles
from report.terminal import shown
from verdicts import Estimate


def test_a_figure_has_a_grid_and_two_spines_and_is_written_in_each_format(tmp_path):
    files = FigureFiles(tmp_path, ["pdf", "png", "svg", "png"])
    with files.figure("two", n_columns=2) as axes:
        assert len(axes) == 2
    assert files.written == [tmp_path / f"two.{form}" for form in ("png", "svg", "pdf")]
    png, svg, pdf = (path.read_bytes() for path in files.written)
    assert png.startswith(b"\x89PNG")
    with Image.open(files.written[0]) as picture:
        assert picture.width == 6.5 * 300
        assert picture.info["dpi"] == pytest.approx((300, 300), abs=0.01)
    assert b"<svg" in svg
    assert pdf.startswith(b"%PDF")
    for place in axes:
        visible = {side for side, spine in place.spines.items() if spine.get_visible()}
        assert visible == {"left", "bottom"}
        assert place.xaxis.get_gridlines()[0].get_visible()


@pytest.mark.parametrize(
    ("linear_up_to", "within", "beyond"),
    [
        (10.0, 10.0, [30.0, 100.0, 300.0]),
        (25.0, 20.0, [30.0, 100.0, 300.0]),
        (79.0, 50.0, [100.0, 300.0, 1000.0]),
        (0.4, 0.2, [1.0, 3.0, 10.0]),
    ],
)
def test_ticks_within_the_linear_part_and_beyond(linear_up_to, within, beyond):
    ticks = symlog_ticks(linear_up_to)
    middle = len(ticks) // 2
    assert ticks[middle] == 0
    assert ticks[middle + 1] == pytest.approx(within)
    assert ticks[middle + 2 : middle + 5] == pytest.approx(beyond)
    assert ticks == [-tick for tick in reversed(ticks)]


def test_figures_on_a_log_show_two_digits_of_half_their_interval():
    assert shown(Estimate(0.12345, 0.11, 0.1369, 50)) == "0.123 ± 0.013"
    assert shown(Estimate(12.345, 10.0, 14.69, 50)) == "12.3 ± 2.3"
    # Without an interval there are three digits behind the point.
    assert shown(Estimate(0.5, 0.5, 0.5, 50)) == "0.500 ± 0.000"
