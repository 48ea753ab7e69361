"""A page on this computer that shows a reduced model: sliders, the deformed solid, its stress in colours."""
