"""Limits and times of the viewer, which change what is sent to the screen and how often, but no number of a result."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewerConstants:
    """Limits and times of the viewer.

    Attributes
    ----------
    address_letters, address_marks, address_number
        Letters of a text in an address (a path on a disk has seldom more), marks (it has 8 kB at most, of some 25 a
        mark) and absolute value of a number (seconds since 1970 are 2e9) at most.
    undo_steps
        Steps that can be undone: more than a hand takes back one by one, at some hundred bytes each.
    mark_states
        States of the marks that the browser may not have yet: it asks for one frame at a time, each of
        which moves them.
    picture_pixels
        Pixels of a picture that is sent to the screen at most: all of a window of 1920 x 1080, less than all of a
        larger one.
    screen_columns
        Columns of a position-time picture, and stretches of a recorded channel, at most: as many as a screen of 3840
        has for them.
    print_columns
        Columns of a picture for print: 17 cm, two columns of a journal, at 300 dpi.
    tile_columns
        Columns of a small picture.
    bar_width
        Px of the screen for the colour bar: seven digits of 12 px, which change with the frame.
    lines_across
        Arrows and directions across the view: each then has some 30 px of a screen of 800, longer than wide and apart
        from the next.
    contour_steps
        Steps between contour lines at most. Chosen; more cover the field.
    circle_corners
        Corners of the polygon that stands for a circle: within 1 - cos(pi / 48) = 0.2 % of its radius.
    mesh_edges
        Elements whose edges are drawn at most: more are a grey surface on a screen of two million pixels.
    reason_letters
        Letters of a frame's reason that are shown at once: two lines of the column.
    max_listed_tests
        Results and tests that a folder's page lists at most, the newest: some 5 ms each.
    range_frames
        Frames, evenly spread, whose values set the colour range of a whole test: they are read within a second.
    raw_frames
        Raw frames that are kept as pictures: those around the one in view.
    frames_at_once
        Frames whose status is read before the page is served again. Measured: 10 ms.
    play_ms
        Least time between two frames that are played: 6 to 7 a second, which the eye can follow.
    view_ms, mark_ms
        Time in which the moves of a view are collected (the picture follows at 25 a second), and those of a mark of a
        region (a mesh of some 1,000 elements is made in that time).
    progress_ms, idle_ms, run_ms
        Time between two parts of the time line; between two checks whether a result has grown, and pictures of that;
        between two reports of a run.
    ahead_ms
        Time between two frames that are read beside the one in view: less than between two that are played.
    slice_s
        Time for which frames are read along a line before they are drawn, or before another line has its turn.
    settled_ns
        Time after which a folder that is changed has another date, whatever the disk's clock ticks in.
    forgotten_ms
        Time after which the data of a closed page are freed: a page that is loaded anew takes less.
    breath_s
        Time for other pages after each page that is freed: an answer takes as long.
    """

    address_letters: int = 1000
    address_marks: int = 200
    address_number: float = 1e10
    undo_steps: int = 100
    mark_states: int = 100
    picture_pixels: int = 2_000_000
    screen_columns: int = 1500
    print_columns: int = 2000
    tile_columns: int = 260
    bar_width: int = 80
    lines_across: int = 24
    contour_steps: int = 10
    circle_corners: int = 48
    mesh_edges: int = 20_000
    reason_letters: int = 90
    max_listed_tests: int = 200
    range_frames: int = 24
    raw_frames: int = 8
    frames_at_once: int = 100
    play_ms: int = 150
    view_ms: int = 40
    mark_ms: int = 60
    progress_ms: int = 200
    idle_ms: int = 1000
    run_ms: int = 500
    ahead_ms: int = 100
    slice_s: float = 0.25
    settled_ns: int = 2_000_000_000
    forgotten_ms: int = 15_000
    breath_s: float = 0.05


VIEWER = ViewerConstants()
