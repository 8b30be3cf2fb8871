"""Figures, reports and pages of text and pictures of a result."""

from rgbmidic.renamed import refuse_old_names
from rgbmidic.tools.report.curves import Curve, history_figure, profile_figure, wave_text
from rgbmidic.tools.report.document import write_batch_page, write_report
from rgbmidic.tools.report.figures import (
    MAPS,
    MapDrawer,
    brightness_figure,
    convergence_figure,
    residual_figure,
)
from rgbmidic.tools.report.gallery import REPORT, remove_pictures, write_figures, write_maps
from rgbmidic.tools.report.movie import FieldMovie, write_movie
from rgbmidic.tools.report.page import render
from rgbmidic.tools.report.style import STYLE, finish_plot, save_figure

__all__ = [
    "MAPS",
    "REPORT",
    "STYLE",
    "Curve",
    "FieldMovie",
    "MapDrawer",
    "brightness_figure",
    "convergence_figure",
    "finish_plot",
    "history_figure",
    "profile_figure",
    "remove_pictures",
    "render",
    "residual_figure",
    "save_figure",
    "wave_text",
    "write_batch_page",
    "write_figures",
    "write_maps",
    "write_movie",
    "write_report",
]


__getattr__ = refuse_old_names(__name__)
