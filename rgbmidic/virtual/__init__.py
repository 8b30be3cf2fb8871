"""Virtual experiments: ray-traced painted bodies under coloured lights, seen by a colour camera, with exact truth."""

from rgbmidic.virtual.camera import Camera, record
from rgbmidic.virtual.fields import AffineField, MeshField
from rgbmidic.virtual.light import Light
from rgbmidic.virtual.rendering import material_points, render, truth
from rgbmidic.virtual.scene import Cylinder, Plate, Scene, Sphere, State
from rgbmidic.virtual.scenes import expose, paper_scene, plate_scene, sphere_scene, strained_plate, turned
from rgbmidic.virtual.spectra import Led, Sensitivities
from rgbmidic.virtual.surface import Finish, Surface, height_map

__all__ = [
    "AffineField",
    "Camera",
    "Cylinder",
    "Finish",
    "Led",
    "Light",
    "MeshField",
    "Plate",
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
    "render",
    "sphere_scene",
    "strained_plate",
    "truth",
    "turned",
]
