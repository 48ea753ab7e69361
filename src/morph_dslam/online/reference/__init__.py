"""The views that frames are compared with."""
