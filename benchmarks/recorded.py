"""The benchmarks and examples whose figures are kept: command, truth, noise, and what was chosen in sight of errors."""

from __future__ import annotations

from dataclasses import dataclass

#: Where the truth of figures comes from.
SAME_MODEL = "simulated: rendered from the same reduced model, so the error of that model is not contained"
MEASURED = "measured"
SOLVED = "finite element solutions that the reduction has not seen"
#: Noise of simulated recordings.
NOISE = "grey values with 2 levels of noise, blur 0.5 to 0.6 px"
#: How the rubber specimens were filmed.
RUBBER = "a real camera with a long lens of unknown intrinsics; landmarks set by hand"
EDGES = (
    "a real camera with a long lens of unknown intrinsics; landmarks at the ends of edges, which are where the grey is "
    "half way between both sides"
)
ABOUT_FORCE = (
    "`factor` is the measured force over the model's, whose two constants were fitted to this specimen's curve and "
    "that of the other notched one."
)


@dataclass(frozen=True)
class Benchmark:
    """A command whose last lines are kept.

    Attributes
    ----------
    section : heading in the page. title : what it is. command : as typed in the project's folder.
    truth : where the truth comes from. lines : how many of the last lines are kept. about : sentences.
    """

    section: str
    title: str
    command: str
    truth: str
    noise: str = ""
    lines: int = 1
    about: str = ""


BENCHMARKS = {
    "rubber_discs": Benchmark(
        "Real objects",
        "Real rubber with 43 stiff discs, stretched by a third",
        "python examples/rubber_tension/run.py --specimen manyincs --data DIR",
        "measured: centroids of the discs, which are painted over for the tracker; found by a script that shares no "
        "code with it and repeats to 0.0004 mm",
        RUBBER,
        7,
        "The line before the report is the half that is painted over in a second run. Chosen with errors in sight: the "
        "discs' diameter, of 1.5 mm (drawn), 1.65 mm and 1.8 mm (where their brightness in the first picture reaches "
        "that of the rubber), and that the frame of rest is the reference.",
    ),
    "rubber_notch_3.6": Benchmark(
        "Real objects",
        "Real rubber with short notches, stretched by a third",
        "python examples/rubber_tension/run.py --specimen notch_3.6mm --data DIR",
        "measured: optical flow of 600 speckles up to frame 100; forces of a testing machine",
        EDGES,
        3,
        ABOUT_FORCE,
    ),
    "rubber_notch_7.2": Benchmark(
        "Real objects",
        "Real rubber with long notches, stretched by a quarter",
        "python examples/rubber_tension/run.py --specimen notch_7.2mm --data DIR",
        "measured: optical flow of 600 speckles up to frame 80; forces of a testing machine",
        EDGES,
        3,
        ABOUT_FORCE,
    ),
    "rubber_identify": Benchmark(
        "Real objects",
        "The rubber's law from one specimen, the force of another from its video",
        "python examples/rubber_tension/identify.py --data DIR",
        "measured: forces of a testing machine, at the stroke of a clamp that moves evenly",
        EDGES,
        lines=8,
        about="Both constants are identified from the force curve of the specimen with long notches up to 10 mm of "
        "stroke. Chosen with both curves in sight: that the law is Mooney and Rivlin's, and that the stroke counts "
        "from the pictures at rest; the last figure is the largest error without that.",
    ),
    "rubber_black": Benchmark(
        "Real objects",
        "Black rubber, by its outline alone",
        "python examples/rubber_tension/run.py --specimen black_notch_3.6mm --data DIR",
        "measured: forces of a testing machine, and that the clamp moves evenly",
        RUBBER,
        2,
        "Another batch than the one whose forces gave the rubber's constants.",
    ),
    "landmark_noise": Benchmark(
        "Tracking",
        "The rubber mat from noisy landmarks",
        "python benchmarks/landmark_noise.py",
        SAME_MODEL,
        f"{NOISE}; landmarks off by 0.5 px in each coordinate",
        1,
        "As they are, with the reference state refined over the sequence (`--refine`), and corrected by the sheet's "
        "outline in their frame (`--snap`).",
    ),
    "rolling_shutter": Benchmark(
        "Tracking",
        "The rubber mat, shaken before a rolling shutter",
        "python benchmarks/rolling_shutter.py",
        SAME_MODEL,
        f"{NOISE}; a readout time of 30 ms",
        1,
        "By a global shutter, by a rolling one whose readout time is stated, and by one whose is not.",
    ),
    "studio_clicks": Benchmark(
        "Tracking",
        "The rubber mat from clicks in the studio",
        "python benchmarks/studio_clicks.py --seeds 5",
        SAME_MODEL,
        f"{NOISE}; clicks off by 1 px in each coordinate",
        1,
        "Tracked with *Snap the start to the outline* and *Refine the start*. Times are those of the server's answers.",
    ),
    "demo": Benchmark(
        "Tracking", "A rubber mat", "python examples/demo/run.py", SAME_MODEL, f"{NOISE}; landmarks off by 0.5 px"
    ),
    "kinect_paper": Benchmark(
        "Real objects",
        "A real sheet of paper",
        "python examples/kinect_paper/run.py --data DIR",
        "measured: 301 points of a depth camera in 12 frames (Varol et al., CVPR 2012)",
        "a real camera with published intrinsics",
        2,
        "The line before the last is the error after one rigid motion of all measured points, and after one in each "
        "frame. Most of the difference is a tilt between the estimate and the measured points; whose error it is, is "
        "not known. The landmarks of the first frame were set by hand.",
    ),
    "boot_seal_track": Benchmark(
        "Tracking",
        "The boot seal in a scanned scene",
        "python examples/boot_seal/track.py",
        SAME_MODEL,
        f"{NOISE}; the depth sensor 1.4 mm at 1 m",
        2,
        "The first line is the distance of a simulated depth sensor's points from the estimated surface, as the paper "
        "measures it (the paper: 1.49 mm mean, 1.33 mm median, with a real seal and a real sensor); `base_mean_mm` is "
        "that of the undeformed frame. The second is the distance of all nodes of the solid from the truth.",
    ),
    "outline_solids": Benchmark(
        "Tracking",
        "The boot seal by its outline",
        "python benchmarks/outline_solids.py",
        SAME_MODEL,
        f"{NOISE}; the place of the plain seal in the map has no error but the map's",
        6,
        "The plain seal is one grey; the printed one is also hidden by a disc, `hidden_share` of it. Beside texture "
        "that is exact to a twentieth of a pixel, the outline neither spoils nor helps in these runs, which are from "
        "before it [corrected the registration](how/uncertainty.md#from-the-reference-state). How a smooth surface's "
        "edge is placed was chosen with the plain seal in sight.",
    ),
    "cross_model": Benchmark(
        "Tracking",
        "The boot seal, filmed from a foreign model",
        "python benchmarks/cross_model.py --seeds 3",
        "simulated with another model: second-order cells on a finer mesh, Yeoh rubber 10 % stiffer, a lever whose "
        "axis is 1 mm and 1 degree off; scanned, registered and tracked with the plain model",
        f"{NOISE}; `disturbed`: also a rolling shutter, a lens and a focal length that are stated wrong, JPEG, "
        "changing exposure, and no readout time stated, with the camera that `morph slam` refines",
        7,
        "`best_mm` is the error of the plain model whose lever and side are fitted to the true displacements; the "
        "limits are 1.2 times that, and 0.4 mm with all disturbances, 0.15 mm without. `von_mises_percent` is the "
        "relative L2 error over the volume, `best_von_mises_percent` that of the best fit. `pose_mm` and "
        "`parameters_mm` say how far the errors of pose and parameters alone move the points. `best_mm` and the stress "
        "of the best fit are errors of the plain model (mesh, law, axis), which no stated deviation contains. Chosen "
        "with seed 61 in sight: that a refined camera keeps a principal point which is not refuted; with seeds 61 to "
        "63: the size of the patches by which points are measured again. The refined camera depends on rounding: seed "
        "61 disturbed has had 0.31 to 0.54 mm with the same code.",
    ),
    "paper_sheet_track": Benchmark(
        "Tracking",
        "The paper's sheet as a free object",
        "python examples/paper_sheet/track.py",
        "simulated: rendered from 801 solved positions, of which the tracker's model has seen 41",
        f"{NOISE}; the depth sensor 1.4 mm at 1 m; landmarks exact",
        3,
        "The first line is the distance of a simulated depth sensor's points from the estimated surface, as the paper "
        "measures it (the paper: 3.98 mm mean, with a real sheet and a depth camera whose own error is 1.2 mm).",
    ),
    "liver": Benchmark(
        "Tracking",
        "A tumour inside a deforming liver",
        "python examples/liver/run.py --data DIR",
        SAME_MODEL,
        NOISE,
        2,
        "The line before the last says how far off the tumour would be if the liver were taken as rigid.",
    ),
    "tracked_seeds": Benchmark(
        "Tracking",
        "The boot seal in five other recordings",
        "python benchmarks/tracked_seeds.py",
        SAME_MODEL,
        "other in each recording",
        6,
        "`sigma95` is the number of stated standard deviations below which 95 % of the errors lie; 1.96 would be "
        "exact.",
    ),
    "live": Benchmark(
        "Tracking",
        "Live tracking of the boot seal, 1280x720 for ten minutes",
        "python benchmarks/live.py --minutes 10 --size 1280x720",
        "none: frame rate, latency and memory only",
    ),
    "phone": Benchmark(
        "Tracking",
        "A phone's browser as the camera",
        "python benchmarks/phone.py",
        SAME_MODEL,
        f"{NOISE}, sent as JPEG; landmarks exact",
        1,
        "Two headless browsers without a graphics card share the two cores with the tracker: a phone would do its part "
        "by itself. Latency is from the camera's frame until its picture, drawn over, is on the page.",
    ),
    "streams": Benchmark(
        "Tracking",
        "What streams cost",
        "python benchmarks/streams.py",
        "none: times over those of the same run without a stream",
        "",
        5,
    ),
    "alternatives": Benchmark(
        "Tracking", "The tracker beside plain alternatives", "python benchmarks/alternatives.py", SAME_MODEL, NOISE, 20
    ),
    "registration_seeds": Benchmark(
        "Registration",
        "The boot seal in twenty scans",
        "python benchmarks/registration_seeds.py",
        "simulated: exact pose and scale",
        "other in each scan",
        about="Thresholds were chosen with the first seven scans in sight; how much of the outline has to be shown "
        "also with the three after these.",
    ),
    "rendered_desks": Benchmark(
        "Registration",
        "Thirty objects on desks among clutter",
        "python benchmarks/rendered_desks.py",
        "simulated: exact pose; right is within 5 mm and 3 degrees",
        "a trembling hand, a rolling shutter, two grey levels",
        about="Without a hint, in maps of one camera. Thresholds were chosen with these desks in sight.",
    ),
    "rendered_desks_fresh": Benchmark(
        "Registration",
        "Fifteen more desks",
        "python benchmarks/rendered_desks.py --first 75 --seeds 15",
        "simulated: exact pose; right is within 5 mm and 3 degrees",
        "a trembling hand, a rolling shutter, two grey levels",
        about="Nothing was chosen with these in sight.",
    ),
    "rendered_desks_metric": Benchmark(
        "Registration",
        "The thirty desks in metric maps, with four clicked points",
        "python benchmarks/rendered_desks.py --metric 1 --hints clicks",
        "simulated: exact pose; right is within 5 mm and 3 degrees",
        "scales of the maps off by 1 % (one standard deviation), clicks of 1 px, a trembling hand, a rolling shutter",
        about="Maps as of a depth camera or a stereo pair. Of two priors of the scale, about equally good, one was "
        "chosen with these desks in sight.",
    ),
    "figurines": Benchmark(
        "Registration",
        "Fifteen smooth figurines of one colour, with four clicked points",
        "python benchmarks/rendered_desks.py --first 1015 --seeds 15 --hints clicks",
        "simulated: exact pose; right is within 6 % of the diagonal, some 8 mm, and 3 degrees",
        "clicks of 1 px, a trembling hand, a rolling shutter, two grey levels",
        about="Animals without a plane, a straight edge or a mark, in maps of one camera. Thresholds were chosen on "
        "others, seeds 1000 to 1014 among them; one rule was chosen with these in sight, and moved one place of "
        "fifteen.",
    ),
    "slam_7scenes": Benchmark(
        "Camera tracking",
        "A real recording: 7-Scenes, red kitchen, 250 frames",
        "python benchmarks/slam_7scenes.py --data DIR",
        "measured: the recording's own camera path, accurate to about a centimetre",
    ),
    "floors": Benchmark(
        "Camera tracking",
        "Times as multiples of a floor",
        "python benchmarks/floors.py --data DIR",
        "none: processor time of a frame over that of OpenCV's Lucas-Kanade of 300 points, in the same run",
        lines=9,
        about=(
            "`p95` is the 95th percentile, `throughput` the frames a second of two threads that work on successive "
            "frames of the seal over those of one."
        ),
    ),
    "slam_rendered": Benchmark(
        "Camera tracking",
        "Rendered scenes",
        "python benchmarks/slam_rendered.py --seeds 5",
        "simulated: exact camera path",
        "2 grey levels",
        10,
    ),
    "camera_check": Benchmark(
        "Camera tracking",
        "Right and wrong cameras",
        "python benchmarks/camera_check.py",
        "simulated: exact camera",
        "2 grey levels",
        12,
        "`no_map` counts films with too few frames for a check.",
    ),
    "slam_long": Benchmark(
        "Camera tracking",
        "Long recordings",
        "python benchmarks/slam_long.py --minutes 3 --noise-frames 20",
        "simulated: exact camera path",
        lines=4,
    ),
    "boot_seal_solve": Benchmark(
        "Mechanics",
        "The boot seal: 104 positions of its lever",
        "python examples/boot_seal/run.py",
        SOLVED,
        lines=2,
        about="The mesh of the paper: 25 795 nodes, 18 403 linear hexahedra.",
    ),
    "hidden_half": Benchmark(
        "Real objects",
        "Half of the sheet of paper painted over",
        "python benchmarks/hidden_half.py --data DIR",
        "measured: points of the hidden half, by a depth camera",
        lines=21,
        about="`measured points` is the model fitted to the measured points of the seen half, without images: what the "
        "model itself knows of the other half. Nothing holds the bicubic sheet where no frame shows it, and it runs "
        "away. `worst_of_today` is against errors of 17.6, 27.1, 7.8 and 7.1 mm of an earlier release, in pictures "
        "that were painted otherwise.",
    ),
    "unknown_loads": Benchmark(
        "Mechanics",
        "What presses, where and how hard",
        "python benchmarks/unknown_loads.py",
        "finite elements with another mesh and law, with contact",
        "0.3 px on points, 0.1 mrad and 0.05 mm on the pose",
        10,
        "The figures without prefix are those where the ball hides what is behind it. The number of loads and the "
        "constants of their prior were chosen at two other places, with the errors there in sight. At the third place "
        "errors are larger than stated, most with 40 % of the surface hidden.",
    ),
    "discretisation": Benchmark(
        "Mechanics",
        "What the certificate says of the elements",
        "python benchmarks/discretisation.py",
        "hex27 cells on a mesh that is finer; of the last four lines, elements of third order solved to the end",
        lines=16,
        about="`displacement` and `load` are stated over true errors: `load` of the push that has the same "
        "displacement. Its true error is positive where elements are too stiff.",
    ),
    "elements": Benchmark(
        "Mechanics",
        "Hexahedra of first and second order on the same nodes",
        "python benchmarks/elements.py",
        "hex27 cells twice as fine along the folds of the seal",
        lines=5,
        about="Half of the boot seal, the lever at 52 degrees. The first two lines compare with `hex27` on the same "
        "nodes, which itself is less exact than `hex8` with enhanced strains.",
    ),
    "contact": Benchmark(
        "Mechanics",
        "Contact: Hertz, a ring and a seal that touch themselves, and what kinks cost",
        "python benchmarks/contact.py",
        "Hertz's closed form; CalculiX on the same mesh for the ring; depths by the check of the certificate; finite "
        "element solutions for the reduced models",
        lines=10,
        about="The reduced models, of 40 solutions each, are of a ball that presses at any place on a block of coarse "
        "cells, once always touching and once from 4 mm above it.",
    ),
    "shells": Benchmark(
        "Mechanics",
        "Shells beside published solutions",
        "python benchmarks/shells.py cantilever hemisphere slit_plate",
        "published: tables of Sze, Liu and Lo (2004), as public repositories have them",
    ),
    "shells_pinched": Benchmark(
        "Mechanics",
        "A pinched half cylinder beside published solutions",
        "python benchmarks/shells.py pinched",
        "published: the table of Sze, Liu and Lo (2004), as public repositories have it",
        lines=11,
    ),
    "boot_seal_felupe": Benchmark(
        "Mechanics",
        "The solver beside felupe",
        "python benchmarks/boot_seal.py",
        "the same problem, solved by felupe with the same linear solver",
        lines=4,
    ),
    "paper_sheet_solve": Benchmark(
        "Mechanics", "The paper's sheet beyond buckling", "python examples/paper_sheet/run.py", SOLVED, lines=2
    ),
    "silicone": Benchmark(
        "Mechanics",
        "A real silicone bar under its own weight",
        "python examples/diffcal_silicone/run.py --data DIR",
        "measured: a depth image of the bar",
    ),
    "silicone_estimate": Benchmark(
        "Mechanics",
        "Its stiffness from its images",
        "python examples/diffcal_silicone/estimate.py --data DIR",
        "published shear modulus 50.1 kPa, identified with linear tetrahedra, which are too stiff in bending",
        lines=12,
    ),
    "silicone_beam": Benchmark(
        "Mechanics",
        "A real silicone beam: fitted to its own weight, two loads predicted",
        "python examples/silicone_beam/run.py --data DIR",
        "measured by motion capture; the hand that held the beam adds up to 0.7 mm",
        lines=11,
    ),
    "vhb": Benchmark(
        "Mechanics",
        "A viscoelastic elastomer",
        "python examples/vhb_viscoelastic/run.py --data DIR",
        "measured: tension tests that the fit has not seen",
        lines=2,
    ),
    "cantilever_pgd": Benchmark(
        "Reduction", "The paper's cantilever by PGD", "python examples/cantilever_pgd/run.py", "direct solves", lines=12
    ),
    "reduction_boot_seal": Benchmark(
        "Reduction",
        "The boot seal: error against number of modes",
        "python benchmarks/reduction_boot_seal.py",
        SOLVED,
        lines=16,
    ),
    "sampling": Benchmark(
        "Reduction", "One parameter: samples by bisection", "python benchmarks/sampling.py", SOLVED, lines=5
    ),
    "reduction_formats": Benchmark(
        "Reduction", "Formats of one field", "python benchmarks/reduction_formats.py", "direct solves", lines=18
    ),
    "reduction_creep": Benchmark(
        "Reduction", "Time as a parameter", "python benchmarks/reduction_creep.py", SOLVED, lines=4
    ),
    "reduction_growth": Benchmark(
        "Reduction", "One to six parameters", "python benchmarks/reduction_growth.py", SOLVED, lines=24
    ),
    "reduction_peers": Benchmark(
        "Reduction", "Beside pyMOR and tensorly", "python benchmarks/reduction_peers.py", SOLVED, lines=20
    ),
}

#: What README.md shows of each: its title, and the figures by key of the last line.
SHOWN = {
    "rubber_discs": ("mean_mm", "p95_mm", "tracked"),
    "rubber_notch_3.6": ("mean_mm", "p95_mm", "tracked"),
    "rubber_notch_7.2": ("mean_mm", "p95_mm", "tracked"),
    "demo": ("mean_mm", "p95_mm", "tracked"),
    "kinect_paper": ("mean_mm", "p95_mm", "tracked"),
    "boot_seal_track": ("mean_mm", "p95_mm", "tracked"),
    "cross_model": ("disturbed_mm", "p95_mm", "tracked"),
    "paper_sheet_track": ("mean_mm", "p95_mm", "tracked"),
}
