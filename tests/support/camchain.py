"""Kalibr's file of the cameras of a rig."""

import yaml


def write_camchain(path, rig):
    """Write the file of two cameras (`RigCamera`) without distortion; the first has the rig's pose."""
    chain = {
        f"cam{number}": {
            "camera_model": "pinhole",
            "intrinsics": part.camera.intrinsics.tolist(),
            "distortion_model": "none",
            "distortion_coeffs": [],
            "resolution": [part.camera.width, part.camera.height],
        }
        for number, part in enumerate(rig)
    }
    chain["cam1"]["T_cn_cnm1"] = rig[1].camera_from_rig.matrix.tolist()
    path.write_text(yaml.safe_dump(chain))
