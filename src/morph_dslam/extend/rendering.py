"""Drawing of models: the rasteriser, textures, overlays on images, and pictures of states."""

from morph_dslam.render.model_view import draw_states
from morph_dslam.render.overlay import draw_overlay
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.scene_file import load_scene_file
from morph_dslam.render.scene_renderer import print_texture
from morph_dslam.render.texture import render_textured, sheet_bounds

__all__ = [
    "draw_overlay",
    "draw_states",
    "load_scene_file",
    "print_texture",
    "rasterise",
    "render_textured",
    "sheet_bounds",
]
