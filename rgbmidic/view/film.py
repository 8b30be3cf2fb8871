"""The button that writes a movie of what is in view, and stops the one that is being written."""

from __future__ import annotations

from rgbmidic.view.models import ResultControls
from rgbmidic.view.picture import warning
from rgbmidic.view.setup_panel import Movie
from rgbmidic.view.shown import ShownFields


class FilmButton:
    """Movies of the fields in view.

    Parameters
    ----------
    parts
        Controls of the page, with the button and what is said of the movie.
    shown
        The fields in view.
    """

    def __init__(self, parts: ResultControls, shown: ShownFields) -> None:
        self._parts, self._shown = parts, shown
        self._movie: Movie | None = None

    def press(self) -> None:
        """Write a movie of what is in view, or stop the one that is being written."""
        if not self._parts.movie.active:
            if self._movie is not None and self._movie.going:
                self.stop(f"{self._movie.out.name} was stopped; no file is left")
            return
        shown, view, names = self._shown, self._shown.view, self._shown.names
        limits: dict[str, tuple[float, float]] = {}
        for name in names:
            first = name == view.field
            if view.range == "test" or (view.range == "hand" and first):
                limits[name] = shown.ends(name, by_hand=first)
        self._movie = Movie.start(
            shown.maps, names, limits=limits, opacity=view.opacity, raw=view.over == "deformed",
            colours=view.palette if len(names) == 1 else "",
        )  # fmt: skip
        self.tell()

    def tell(self) -> None:
        """Show how far the movie is."""
        if self._movie is None:
            return
        text, going = self._movie.summary(), self._movie.going
        self._parts.said.text, self._parts.said.visible = text, True
        self._parts.movie.label = "■ Movie" if going else "Movie"
        if not going:
            self._movie, self._parts.movie.active = None, False

    def stop(self, text: str) -> None:
        """Stop the movie, and show why."""
        if self._movie is not None:
            self._movie.stop()
        self._movie, self._parts.movie.label, self._parts.movie.active = None, "Movie", False
        self._parts.said.text, self._parts.said.visible = warning(text), True
