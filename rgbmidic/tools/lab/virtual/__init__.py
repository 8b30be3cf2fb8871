"""Virtual experiments: ray-traced painted bodies under coloured lights, seen by a colour camera, with exact truth."""

from rgbmidic.tools.lab.virtual.dataset import record
from rgbmidic.tools.lab.virtual.rendering import (
    expose,
    paper_scene,
    plate_scene,
    render,
    sphere_scene,
    strained_plate,
    turned,
)
from rgbmidic.tools.scene.camera import Camera, Light, Polarisers, reference_camera
from rgbmidic.tools.scene.scene import Cylinder, Plate, Scene, Sphere, State
from rgbmidic.tools.scene.spectra import Led, Sensitivities
from rgbmidic.tools.scene.surface import AffineField, Finish, MeshField, Surface, height_map
from rgbmidic.tools.scene.zones import material_points, truth

__all__ = [
    "AffineField",
    "Camera",
    "Cylinder",
    "Finish",
    "Led",
    "Light",
    "MeshField",
    "Plate",
    "Polarisers",
    "Scene",
    "Sensitivities",
    "Sphere",
    "State",
    "Surface",
    "expose",
    "height_map",
    "material_points",
    "paper_scene",
    "plate_scene",
    "record",
    "reference_camera",
    "render",
    "sphere_scene",
    "strained_plate",
    "truth",
    "turned",
]
