"""The chart of when a run did what."""

from jaxsense.show import timeline
from jaxsense.summary.profile import MAIN, Span

SPANS = [
    Span("import", "", "", MAIN, 1.0, 3.0),
    Span("wait_stages", "", "", MAIN, 3.0, 9.0),
    Span("compile", "best_jmvae", "begin", "compile_0", 2.0, 4.0),
    Span("trace", "dqn", "begin", "trace_0", 2.0, 6.0),
    Span("run", "dqn", "begin", "stage_1", 6.0, 7.0),
    Span("run", "best_jmvae", "begin", "stage_0", 7.0, 9.0),
]


def test_stages_stand_in_the_order_in_which_they_run():
    (axes,) = timeline.timeline(SPANS).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        "command",
        "dqn",
        "best_jmvae",
    ]
    assert axes.get_xlim()[0] == 1
    assert axes.yaxis_inverted()


def test_programs_stand_above_what_is_done_with_them_and_waiting_for_stages_is_left_out():
    figure = timeline.timeline(SPANS)
    figure.draw_without_rendering()
    (axes,) = figure.axes
    bars = [path.get_extents() for each in axes.collections for path in each.get_paths()]
    drawn = {(box.x0, box.x1): (box.y0, box.y1) for box in bars}
    assert set(drawn) == {(1, 3), (2, 4), (2, 6), (6, 7), (7, 9)}
    assert drawn[2, 6][1] == drawn[6, 7][0] == 1  # dqn, where the axis points down
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[0] == "starting, summing up"
    assert len(labels) == len(set(labels)) == 8


def test_a_run_that_recorded_nothing_is_drawn():
    timeline.timeline([]).draw_without_rendering()
