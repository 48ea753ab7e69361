"""Follow a tumour inside of a liver that deforms, in a recording that shows the surface alone.

The liver's mesh is not part of the project (`organ.py` says which file is read). It is meshed anew, its
reduced model built over three loads, and a recording rendered: a camera goes round the undeformed liver and
maps the scene, then the left lobe is lifted and pulled and the front is pushed. The liver's mesh is found in
the map, and pose and loads are estimated in every frame. The tumour, an ellipsoid some 20 mm below the
surface, is carried by the displacement field; where it really is, is known, because the recording is rendered
from the same model.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from comparison import Comparison, compare, plot, result_line
from organ import PATCHES, SIZE, TUMOUR_AXES, TUMOUR_CENTRE, ellipsoid, fine_liver
from organ_mesh import organ_mesh, write_inp

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.models import CarriedStructure, MaterialPoints, save_inner_structure
from morph_dslam.extend.registration import registration_line, run_registration
from morph_dslam.extend.reports import distances_to_surface
from morph_dslam.extend.slam import run_slam
from morph_dslam.extend.studies import load_snapshot, place_inner_structure, snapshot_key
from support import data_folder, keep, keep_sequence

HERE = Path(__file__).resolve().parent
OUTPUT = HERE / "output"
MODEL, MESH, TUMOUR = OUTPUT / "liver.morph", OUTPUT / "liver.inp", OUTPUT / "tumour.h5"
SEQUENCE = OUTPUT / "recording"
#: The map is kept as it is from this frame on.
FROZEN_AT = 130


def make_model(data: Path) -> md.ReducedModel:
    """Mesh the liver and build its model, unless that was done."""
    file = data / "sofa_mor" / "liverFine.vtu"
    fine, study = fine_liver(file), HERE / "study.toml"
    code = [HERE / "organ.py", HERE / "organ_mesh.py"]
    keep(MESH, [file, *code], lambda: write_inp(MESH, organ_mesh(fine, SIZE, PATCHES)))
    keep(MODEL, [study, MESH], lambda: md.build(study, MODEL))
    return md.load_model(MODEL)


def make_tumour(model: md.ReducedModel) -> CarriedStructure:
    """Place the tumour in the model and write its file; says how deep it lies."""
    nodes, triangles = ellipsoid(np.array(TUMOUR_CENTRE), np.array(TUMOUR_AXES))
    tumour = place_inner_structure(model, "tumour", nodes, triangles)
    save_inner_structure(TUMOUR, tumour)
    carried = tumour.carried_by(model)
    error = 1e3 * largest_model_error(model, carried, tumour.points)
    points = np.vstack([nodes, TUMOUR_CENTRE])
    depths = 1e3 * distances_to_surface(points, model.nodes, model.triangles)
    print(f"tumour  {depths[-1]:.1f} mm deep in the middle, {depths.min():.1f} mm where it is nearest")
    print(f"        on unseen loads the model has it {error:.3f} mm off the solver's at most")
    return carried


def largest_model_error(model: md.ReducedModel, tumour: CarriedStructure, points: MaterialPoints) -> float:
    """How far the model's tumour is from the solver's, metres: any node, any unseen solution."""
    study, folder = md.load_study(HERE / "study.toml"), MODEL.with_name(MODEL.name + ".snapshots")
    largest = 0.0
    for mu in np.array(model.certificate["held_out"]["coordinates"]):
        nodes = load_snapshot(folder / f"{snapshot_key(study, mu)}.npz").fields["displacement"]
        solved = tumour.rest + np.einsum("pc,pcx->px", points.weights, nodes[points.corners])
        largest = max(largest, float(np.linalg.norm(tumour.nodes(mu) - solved, axis=1).max()))
    return largest


def track_from_landmarks(folder: Path) -> dict:
    """Track the whole recording from points of frame 0 that are known exactly."""
    return md.track(
        md.TrackOptions(
            frames=SEQUENCE / "frames",
            model=MODEL,
            camera=SEQUENCE / "camera.yaml",
            landmarks=SEQUENCE / "landmarks.csv",
            inner=(TUMOUR,),
            output=folder,
            video=False,
            overwrite=True,
        )
    )


def track_from_map(folder: Path) -> dict:
    """Map the scene, find the liver in the map, and track from there."""
    camera, frames = SEQUENCE / "camera.yaml", SEQUENCE / "frames"
    scan, place = OUTPUT / "scan", OUTPUT / "registration"
    run_slam(source=frames, camera=camera, output=scan, first=0, last=FROZEN_AT, overwrite=True)
    registration = run_registration(scan / "map.h5", MODEL, camera, place, overwrite=True)
    print(registration_line(registration))
    return md.track(
        md.TrackOptions(
            frames=frames,
            model=MODEL,
            camera=camera,
            registration=place / "registration.json",
            first=registration.frame,  # the frames before are the scan
            inner=(TUMOUR,),
            output=folder,
            overwrite=True,
        )
    )


def write_figures(path: Path, found: Comparison) -> None:
    """Errors by frame, millimetres."""
    content = {
        "frame": found.frames.tolist(),
        "deformed": found.deformed.tolist(),
        "tumour_error_mm": (1e3 * found.tumour).tolist(),
        "mean_error_mm": (1e3 * found.organ).tolist(),
        "organ_taken_for_rigid_mm": (1e3 * found.undeformed).tolist(),
        "normalised_centre_error_p95": found.normalised(),
    }
    path.write_text(json.dumps(content, indent=1) + "\n")


def run(arguments: argparse.Namespace) -> None:
    OUTPUT.mkdir(exist_ok=True)
    model = make_model(arguments.data)
    error = model.certificate["displacement"]
    print(f"model   on unseen loads {error['mean_mm']:.3f} mm off, relative error {error['relative_l2']:.2%}")
    tumour = make_tumour(model)
    keep_sequence(HERE / "scene.toml", MODEL, SEQUENCE)
    for name, follow in (("run_from_landmarks", track_from_landmarks), ("run", track_from_map)):
        folder = OUTPUT / name
        summary = follow(folder)
        found = compare(folder, SEQUENCE, model, tumour)
        write_figures(folder / "errors.json", found)
        plot(folder / "plots" / "tumour.png", found, model.parameters)
        rigid = 1e3 * found.undeformed[found.deformed]
        print(f"{name}: were the organ rigid, mean {rigid.mean():.2f}, at most {rigid.max():.2f} mm")
        print(f"plot    {folder / 'plots' / 'tumour.png'}")
        print(result_line(found, summary))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=data_folder("fem_reference"), help="folder of meshes (%(default)s)"
    )
    return run_and_report_errors(run, parser.parse_args(), "what was done so far is kept")


if __name__ == "__main__":
    sys.exit(main())
