"""Exports read back by other programs' readers: the states, the mesh, and every field in closed form."""

import csv
import signal
from dataclasses import replace
from xml.etree import ElementTree

import meshio
import numpy as np
import pygltflib
import pytest
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from morph_dslam.cli import app as cli
from morph_dslam.errors import ExportError, ParameterError
from morph_dslam.extend.studies import build_rigid
from morph_dslam.io.export import export
from morph_dslam.io.gltf import FRAMES_PER_SECOND
from morph_dslam.io.state_choice import StateChoice
from morph_dslam.meshing.generators import block
from morph_dslam.model import save_model
from morph_dslam.studies.external_table import SolutionTable
from tests.support.bent_sheet import bent_sheet_model
from tests.support.stretched_block import SHEAR_MODULUS, SIZE, YOUNG_MODULUS, stretched_block_model


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    save_model(folder / "block.morph", stretched_block_model())
    save_model(folder / "sheet.morph", bent_sheet_model(9, 7))
    return folder


def assert_block_state(points, cells, data, stretch, slide_mm):
    """Everything an export of the block holds, from its closed form."""
    model, slope = stretched_block_model(), 1e-3 * slide_mm / SIZE[2]
    np.testing.assert_allclose(points, model.nodes)
    np.testing.assert_array_equal(cells, model.cells["hex8"])
    x, _, z = points.T
    motion = np.zeros((len(points), 3))
    motion[:, 0] = stretch * x + slope * z
    stress, strain = np.zeros((2, 3, 3))
    stress[0, 0], stress[0, 2], stress[2, 0] = YOUNG_MODULUS * stretch, *[SHEAR_MODULUS * slope] * 2
    strain[0, 0], strain[0, 2], strain[2, 0] = stretch, slope / 2, slope / 2
    np.testing.assert_allclose(data["displacement"], motion, atol=1e-9)
    np.testing.assert_allclose(data["stress"], np.tile(stress.ravel(), (len(points), 1)), atol=0.1)
    np.testing.assert_allclose(data["strain"], np.tile(strain.ravel(), (len(points), 1)), atol=1e-8)
    equivalent = np.hypot(YOUNG_MODULUS * stretch, 3**0.5 * SHEAR_MODULUS * slope)
    np.testing.assert_allclose(data["von_mises"].ravel(), equivalent, rtol=1e-6)


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


GRID = ["--vary", "stretch=-0.1:0.2:2", "--vary", "slide=-5:10:3"]
STATES = [(s, d) for s in (-0.1, 0.2) for d in (-5.0, 2.5, 10.0)]


def run_export(folder, out, *options):
    assert cli.main(["export", str(folder / "block.morph"), "-o", str(out), *options]) == 0


def test_a_vtu_series_over_a_grid(folder, tmp_path):
    run_export(folder, tmp_path / "out", "--format", "vtu", *GRID)
    rows = table(tmp_path / "out" / "states.csv")
    values = [(float(row["stretch [1]"]), float(row["slide [mm]"])) for row in rows]
    np.testing.assert_allclose(values, STATES, rtol=1e-8)
    for row, state in zip(rows, STATES, strict=True):
        mesh = meshio.read(tmp_path / "out" / row["file"])
        assert_block_state(mesh.points, mesh.cells_dict["hexahedron"], mesh.point_data, *state)
        assert f'file="{row["file"]}"' in (tmp_path / "out" / "block.pvd").read_text()


def test_an_xdmf_series_over_a_grid(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # meshio by itself would write the HDF5 file here
    run_export(folder, tmp_path / "out", *GRID)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"block.xdmf", "block.h5", "states.csv"}
    with meshio.xdmf.TimeSeriesReader(tmp_path / "out" / "block.xdmf") as series:
        points, cells = series.read_points_cells()
        assert series.num_steps == len(STATES)
        for i, state in enumerate(STATES):
            step, data, _ = series.read_data(i)
            assert step == i
            assert_block_state(points, cells[0].data, data, *state)


@pytest.mark.parametrize(
    ("cell_type", "name", "size"),
    [
        ("tet4", "tetra", 4), ("tet10", "tetra10", 10),
        ("hex8", "hexahedron", 8), ("hex20", "hexahedron20", 20), ("hex27", "hexahedron27", 27),
        ("prism6", "wedge", 6), ("prism15", "wedge", 6), ("prism18", "wedge18", 18),
    ],
)  # fmt: skip
@pytest.mark.parametrize("file_format", ["vtu", "xdmf"])
def test_every_type_of_cell(cell_type, name, size, file_format, tmp_path):
    """meshio has no prisms of 15 nodes: their corners are written."""
    mesh = block(SIZE, (2, 1, 1), cell_type)
    model = stretched_block_model()
    modes = np.zeros((2, len(mesh.nodes), 3))
    model = replace(
        model,
        nodes=mesh.nodes,
        triangles=mesh.surface_triangles(),
        displacement=replace(model.displacement, modes=modes),
        stresses={},
        strain=None,
        cells={cell_type: mesh.blocks[0].connectivity},
    )
    save_model(tmp_path / "block.morph", model)
    target = export(tmp_path / "block.morph", tmp_path, file_format, StateChoice(vary=["slide=0:1:2"]))
    if file_format == "vtu":
        read = meshio.read(tmp_path / "block_0001.vtu")
        cells, data = read.cells_dict[name], read.point_data
    else:
        with meshio.xdmf.TimeSeriesReader(target) as series:
            (cells,) = (part.data for part in series.read_points_cells()[1] if part.type == name)
            _, data, _ = series.read_data(1)
    np.testing.assert_array_equal(cells, mesh.blocks[0].connectivity[:, :size])
    assert set(data) == {"displacement"}


def test_stress_on_both_faces_of_a_sheet(folder, tmp_path):
    choice = StateChoice(vary=["arch=40:40:1"])
    export(folder / "sheet.morph", tmp_path, "vtu", choice)
    mesh = meshio.read(tmp_path / "sheet_0000.vtu")
    top, bottom = (
        np.column_stack([mesh.point_data[f"stress_{face}_{c}"] for c in ("11", "22", "12")])
        for face in ("top", "bottom")
    )
    # An arch of height a over length L: w,xx = -8 a / L², bending stress E z / (1 - nu²) at z = 0.05 mm.
    bending = 3e9 * 0.05e-3 / (1 - 0.3**2) * 8 * 0.040 / 0.420**2
    np.testing.assert_allclose(top, np.tile([bending, 0.3 * bending, 0.0], (len(top), 1)), rtol=1e-5)
    np.testing.assert_allclose(bottom, -top, rtol=1e-6)
    equivalent = bending * np.sqrt(1 - 0.3 + 0.3**2)
    np.testing.assert_allclose(mesh.point_data["von_mises_top"], equivalent, rtol=1e-5)
    np.testing.assert_array_equal(mesh.cells_dict["triangle"], bent_sheet_model(9, 7).triangles)


def gltf_array(document, index):
    """An accessor's numbers, and whether its stated bounds are theirs."""
    accessor = document.accessors[index]
    view = document.bufferViews[accessor.bufferView]
    blob = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    values = np.frombuffer(blob, dtype={5126: "<f4", 5125: "<u4", 5123: "<u2"}[accessor.componentType])
    values = values.reshape(accessor.count, {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type])
    np.testing.assert_array_equal(values.min(axis=0), np.float32(accessor.min))
    np.testing.assert_array_equal(values.max(axis=0), np.float32(accessor.max))
    return values


def test_modes_as_a_gltf_animation_are_the_sheet_in_motion(folder, tmp_path):
    """Rest positions and weighted morph targets, as a viewer adds them, against the model's closed form."""
    model = bent_sheet_model(9, 7)
    choice = StateChoice(vary=["arch=-60:60:5"], at=["skew=0.3", "twist=10"])
    document = pygltflib.GLTF2().load(export(folder / "sheet.morph", tmp_path, "gltf", choice, "none"))
    (primitive,) = document.meshes[0].primitives
    rest = gltf_array(document, primitive.attributes.POSITION)
    targets = [gltf_array(document, target["POSITION"]) for target in primitive.targets]
    triangles = gltf_array(document, primitive.indices).reshape(-1, 3)
    np.testing.assert_allclose(rest[triangles], model.nodes[model.triangles], atol=1e-7)
    (channel,), (sampler,) = document.animations[0].channels, document.animations[0].samplers
    assert (channel.target.node, channel.target.path) == (0, "weights")
    times = gltf_array(document, sampler.input).ravel()
    weights = gltf_array(document, sampler.output).reshape(len(times), len(targets))
    np.testing.assert_allclose(times * FRAMES_PER_SECOND, np.arange(5), atol=1e-6)
    np.testing.assert_array_equal(np.float32(document.meshes[0].weights), weights[0])
    for arch, weight in zip(np.linspace(-0.06, 0.06, 5), weights, strict=True):
        moved = rest + np.tensordot(weight, np.array(targets), axes=1)
        expected = model.positions(np.array([arch, 0.3, np.radians(10)]))
        np.testing.assert_allclose(moved[triangles], expected[model.triangles], atol=1e-7)


def sizes_at(document, time):
    """The size of each node below the first one, by its scale or by the animation's steps, as a viewer plays it."""
    sizes = {node: document.nodes[node].scale or [1.0, 1.0, 1.0] for node in document.nodes[0].children}
    for animation in document.animations:
        for channel in animation.channels:
            sampler = animation.samplers[channel.sampler]
            assert (channel.target.path, sampler.interpolation) == ("scale", "STEP")
            times = gltf_array(document, sampler.input).ravel()
            assert (np.diff(times) > 0).all()
            sizes[channel.target.node] = gltf_array(document, sampler.output)[np.searchsorted(times, time, "right") - 1]
    return {node: tuple(size) for node, size in sizes.items()}


def drawn(document, time):
    """Corners of the triangles that are seen at a time, object frame, and their colours as linear shares of one."""
    sizes = sizes_at(document, time)
    (node,) = (document.nodes[number] for number, size in sizes.items() if size == (1.0, 1.0, 1.0))
    assert sorted(sizes.values())[:-1] == [(0.0, 0.0, 0.0)] * (len(sizes) - 1)
    (primitive,) = document.meshes[node.mesh].primitives
    triangles = gltf_array(document, primitive.indices).reshape(-1, 3)
    positions = gltf_array(document, primitive.attributes.POSITION) + np.array(node.translation)
    assert document.accessors[primitive.attributes.COLOR_0].normalized
    colours = gltf_array(document, primitive.attributes.COLOR_0) / 65535.0
    return positions[triangles], colours[triangles]


def linear(srgb):
    """IEC 61966-2-1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def assert_coloured(found, values, model, shown_to):
    """Colours of corners are those of the nodes' values, from matplotlib's own map."""
    expected = ScalarMappable(Normalize(0.0, shown_to), "turbo").to_rgba(values)
    expected[:, :3] = linear(expected[:, :3])
    # A value at the border of two of the map's 256 colours may fall to either: neighbours differ by 0.04 at most.
    differences = np.abs(found - expected[model.triangles]).max(axis=(1, 2))
    assert differences.max() < 0.04
    assert np.quantile(differences, 0.95) < 1e-4


@pytest.mark.parametrize("show", [None, "strain", "displacement"])
def test_a_gltf_animation_shows_each_state_in_its_colours(folder, tmp_path, show):
    """What is drawn while each state is shown, from the closed form of a block that is pulled and sheared."""
    model, choice = stretched_block_model(), StateChoice(vary=["stretch=0:0.2:3"], at=["slide=5"])
    document = pygltflib.GLTF2().load(export(folder / "block.morph", tmp_path, "gltf", choice, show))
    stretches, slope = np.array([0.0, 0.1, 0.2]), 5e-3 / SIZE[2]
    x, _, z = model.nodes.T
    motions = np.array([np.column_stack([s * x + slope * z, 0 * x, 0 * x]) for s in stretches])
    # Of a strain (a, 0, 0) and its shear c / 2: sqrt(2/3 (2/3 a² + c² / 2)).
    uniform = {
        None: 1e-6 * np.hypot(YOUNG_MODULUS * stretches, 3**0.5 * SHEAR_MODULUS * slope),
        "strain": 100 * np.sqrt(4 / 9 * stretches**2 + slope**2 / 3),
    }
    if show == "displacement":
        values = 1e3 * np.linalg.norm(motions, axis=2)
    else:
        values = np.tile(uniform[show][:, None], len(model.nodes))
    legend = document.nodes[0].extras["colours"]
    label = {
        None: ("von Mises stress", "MPa"),
        "strain": ("equivalent strain", "%"),
        "displacement": ("displacement", "mm"),
    }
    assert (legend["field"], legend["unit"]) == label[show]
    on_surface = values[:, np.unique(model.triangles)]
    assert legend["range"] == [0.0, pytest.approx(np.percentile(on_surface, 99.5), rel=1e-5)]
    for i, motion in enumerate(motions):
        corners, colours = drawn(document, (i + 0.5) / FRAMES_PER_SECOND)
        np.testing.assert_allclose(corners, (model.nodes + motion)[model.triangles], atol=1e-7)
        assert_coloured(colours, values[i], model, legend["range"][1])
    assert sizes_at(document, 10.0) == sizes_at(document, 2.5 / FRAMES_PER_SECOND)
    document.animations = []  # viewers that do not play show the first state
    np.testing.assert_array_equal(drawn(document, 0.0)[0], drawn(document, 0.5 / FRAMES_PER_SECOND)[0])


def test_a_gltf_of_one_state_stands_still(tmp_path):
    """Of a model and a state in memory."""
    model = stretched_block_model()
    document = pygltflib.GLTF2().load(export(model, tmp_path, "gltf", [0.2, 0.0]))
    assert document.animations == []
    np.testing.assert_allclose(drawn(document, 0.0)[0][..., 0], 1.2 * model.nodes[model.triangles][..., 0], atol=1e-7)
    document = pygltflib.GLTF2().load(export(model, tmp_path, "gltf", [0.2, 0.0], "none"))
    assert document.animations == []
    assert document.meshes[0].weights == pytest.approx([0.2, 0.0])


def test_colours_that_cannot_be_are_refused(folder, tmp_path, refused):
    words = ("export", folder / "sheet.morph", "-o", tmp_path / "out", "--show", "strain")
    assert "holds no strain to show (--show); it has: stress, displacement" in refused(*words, "--format", "gltf")
    assert "chooses the colours of a glTF file" in refused(*words)


def test_without_ranges_each_parameter_tours_its_range(folder):
    model = stretched_block_model()
    states = StateChoice(at=["slide=2"]).states(model)
    np.testing.assert_allclose(states[[0, -1]], [[0.0, 0.002]] * 2)
    moving = np.abs(np.diff(states, axis=0)) > 1e-12
    assert (moving.sum(axis=1) == 1).all()
    for k in range(2):
        assert {model.lower[k], model.upper[k]} <= set(states[:, k])


def test_a_path_from_a_table_of_states_and_from_a_tracked_run(tmp_path):
    model = stretched_block_model()
    states = tmp_path / "states.csv"
    states.write_text("file,slide [mm],stretch [1]\na,1,0.1\nb,2.5,-0.2\n")
    np.testing.assert_allclose(StateChoice(path=states).states(model), [[0.1, 0.001], [-0.2, 0.0025]])
    frames = tmp_path / "frames.csv"
    frames.write_text("frame,slide_mm,slide_std_mm\n0,1,0.1\n1,,\n2,10.000001,0.1\n")
    found = StateChoice(path=frames, at=["stretch=0.1"]).states(model)
    np.testing.assert_allclose(found, [[0.1, 0.001], [0.1, 0.01]], rtol=1e-12)


def times_of_series(folder):
    """Those of the XDMF series by meshio, or of the collection of VTU files."""
    if (folder / "stretched_block.pvd").exists():
        sets = ElementTree.parse(folder / "stretched_block.pvd").getroot().iter("DataSet")
        return [float(part.get("timestep", "nan")) for part in sets]
    with meshio.xdmf.TimeSeriesReader(folder / "stretched_block.xdmf") as series:
        series.read_points_cells()
        return [series.read_data(i)[0] for i in range(series.num_steps)]


@pytest.mark.parametrize("file_format", ["xdmf", "vtu"])
@pytest.mark.parametrize(
    ("rows", "origins", "times"),
    [
        ("frame,time_s,slide_mm\n7,0.5,1\n8,,\n12,0.75,2\n", {"from_frame": ["7", "12"]}, [0.5, 0.75]),
        ("slide_mm,time [s]\n1,1e9\n\n2,1000000000.25\n", {"from_line": ["2", "4"]}, [1e9, 1e9 + 0.25]),
        ("slide_mm,stamp_s\n1,0.5\n2,0.75\n", {"from_line": ["2", "3"]}, [0, 1]),
        ("frame,timestamp_s,slide_mm\n7,0.5,1\n8,0.75,2\n", {"from_frame": ["7", "8"]}, [0.5, 0.75]),
        # The time of a run's frames, not a parameter of that name, which is estimated.
        (
            "frame,timestamp_s,pose_from,slide_mm,time_s\n7,0.5,,1,2\n8,0.75,,2,9\n",
            {"from_frame": ["7", "8"]},
            [0.5, 0.75],
        ),
        ("slide_mm,time_s\n1,0.5\n2,0.5\n", {"from_line": ["2", "3"]}, [0, 1]),  # of a grid
        ("slide_mm,time_s\n1,0.5\n2,\n", {"from_line": ["2", "3"]}, [0, 1]),
    ],
)
def test_states_of_a_path_say_where_and_when_they_are(rows, origins, times, file_format, tmp_path):
    (tmp_path / "path.csv").write_text(rows)
    export(stretched_block_model(), tmp_path / "out", file_format, StateChoice(path=tmp_path / "path.csv"))
    found = table(tmp_path / "out" / "states.csv")
    assert {title: [row[title] for row in found] for title in found[0] if title.startswith("from")} == origins
    np.testing.assert_allclose(times_of_series(tmp_path / "out"), times, rtol=1e-15)


def test_a_study_takes_the_table_of_an_exported_path(tmp_path):
    (tmp_path / "frames.csv").write_text("frame,slide_mm,stretch_1\n3,1,0.1\n4,2,-0.1\n")
    export(stretched_block_model(), tmp_path / "out", "vtu", StateChoice(path=tmp_path / "frames.csv"))
    parameters, values = SolutionTable(tmp_path / "out" / "states.csv").parameters()
    assert [p.name for p in parameters] == ["stretch", "slide"]
    np.testing.assert_allclose(values, [[0.1, 0.001], [-0.1, 0.002]])


class Interrupting:
    """Functions of the parameters, the third use of which comes with Ctrl-C."""

    def __init__(self, functions):
        self._functions, self._used = functions, 0

    def __getattr__(self, name):
        return getattr(self._functions, name)

    def rows(self, mu):
        self._used += 1
        if self._used == 3:
            signal.raise_signal(signal.SIGINT)
        return self._functions.rows(mu)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("file_format", ["xdmf", "vtu", "gltf"])
def test_what_an_interrupted_export_leaves_is_whole(file_format, tmp_path):
    """Three states of ten, the third of which was interrupted; of an animation nothing, nor of the export before."""
    model = stretched_block_model()
    export(model, tmp_path, file_format, np.zeros((4, 2)))
    displacement = replace(model.displacement, functions=Interrupting(model.displacement.functions))
    states = np.column_stack([np.zeros(10), np.linspace(0.0, 9e-3, 10)])
    with pytest.raises(KeyboardInterrupt):
        export(replace(model, displacement=displacement), tmp_path, file_format, states)
    if file_format == "gltf":
        assert not list(tmp_path.iterdir())
        return
    rows = table(tmp_path / "states.csv")
    np.testing.assert_allclose([float(row["slide [mm]"]) for row in rows], [0.0, 1.0, 2.0], atol=1e-9)
    assert times_of_series(tmp_path) == [0, 1, 2]
    if file_format == "vtu":
        meshes = [meshio.read(tmp_path / row["file"]) for row in rows]
        found = [(mesh.points, mesh.cells[0].data, mesh.point_data) for mesh in meshes]
        assert len(list(tmp_path.glob("*.vtu"))) == 3
    else:
        with meshio.xdmf.TimeSeriesReader(tmp_path / "stretched_block.xdmf") as series:
            points, cells = series.read_points_cells()
            found = [(points, cells[0].data, series.read_data(i)[1]) for i in range(3)]
    for i, parts in enumerate(found):
        assert_block_state(*parts, 0.0, float(i))


@pytest.mark.parametrize(
    ("titles", "slide"),
    [
        ("slide [cm]", 0.005),
        ("slide_m", 0.5),
        ("slide [um]", 0.5e-6),
        ("slide_mm,slide_std_m,slide_at_bound", 0.5e-3),
        ("slide_rms,slide [mm]", 1.5e-3),
        ("slide_m,slide_mm", 1.5e-3),  # "time_ms" of a tracked run beside the parameter "time"
    ],
)
def test_a_path_may_have_another_unit_of_the_quantity(titles, slide, tmp_path):
    values = ("0.5", "1.5", "2.5")[: titles.count(",") + 1]
    (tmp_path / "path.csv").write_text(f"stretch_1,{titles}\n0.1,{','.join(values)}\n")
    model = stretched_block_model()
    model = replace(model, parameters=(model.parameters[0], replace(model.parameters[1], lower=0.0, upper=1.0)))
    found = StateChoice(path=tmp_path / "path.csv").states(model)
    np.testing.assert_allclose(found, [[0.1, slide]], rtol=1e-12)


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"vary": ["bend=0:1:3"]}, "no parameter 'bend'; it has stretch, slide"),
        ({"vary": ["slide=0:11:3"]}, "--vary slide=0:11:3: 11 is outside the range of slide, -10 to 10 mm"),
        ({"vary": ["slide=0:1:3"], "at": ["slide=1"]}, "'slide' is both varied and fixed"),
        ({"vary": ["slide=0:10"]}, "--vary slide=0:10 is not a parameter and its values, such as stretch=-0.2:0.2:21"),
        ({"vary": ["slide=0:nan:3"]}, "nan is outside the range"),
        ({"vary": ["slide=0:1:0"]}, "is not a parameter and its values"),
        ({"vary": ["slide=0:1:2", "slide=0:1:2"]}, "'slide' has a range already"),
        ({"vary": ["slide=0:1:1000000000"]}, "10000 is the most"),
        ({"vary": ["slide=0:1:101", "stretch=0:0.1:101"]}, "make 10201 states"),
        ({"at": ["slide=5", "slide=0.6 cm"]}, "--at slide=5 and --at slide=0.6 cm both set 'slide'"),
        ({"at": ["slide"]}, "--at slide is not a parameter and its value, such as stretch=-0.2"),
        ({"at": ["slide=x"]}, "--at slide=x: 'x' is not a value of slide: write a number in mm, or with another unit"),
        ({"at": ["slide=2 cm"]}, "--at slide=2 cm: 20 is outside the range of slide, -10 to 10 mm"),
        ({"at": ["slide=2mN"]}, "'mN' is not a unit of length"),
        ({"vary": ["slide=0:1:2"], "path": "p.csv"}, "give one of them"),
        ({"path": "absent.csv"}, r"cannot read the path .*absent\.csv"),
        ({"path": ("a,b\n1,2\n",)}, r"no column of a parameter; name the columns 'stretch \[1\]', 'slide"),
        ({"path": ("slide_mm,slide [mm]\n1,2\n",)}, r"columns 'slide_mm' and 'slide \[mm\]' both hold 'slide'"),
        ({"path": ("slide_mm,slide_mm\n1,2\n",)}, "columns 'slide_mm' and 'slide_mm' both hold 'slide'"),
        ({"path": ("slide [mm],slide [cm]\n1,2\n",)}, r"columns 'slide \[mm\]' and 'slide \[cm\]' both hold 'slide'"),
        ({"path": ("slide [mm],stretch [mm]\n1,0\n",)}, r"'stretch \[mm\]' has no unit of 'stretch': name it 'stretch"),
        ({"path": ("slide [mm],stretch\n1,0\n",)}, "'stretch' has no unit of 'stretch'"),
        ({"path": ("slide_N,stretch_1\n1,0\n",)}, r"'slide_N' has no unit .* name it 'slide \[mm\]'.*\(m, cm, mm"),
        ({"path": ("slide [furlong],stretch_1\n1,0\n",)}, r"'slide \[furlong\]' has no unit of 'slide'"),
        ({"path": ("slide [cm]\n2\n",)}, "line 2: 20 is outside the range of slide, -10 to 10 mm"),
        ({"path": ("slide [cm]\nmany\n",)}, "'many' is not a value of slide: write a number in cm"),
        ({"path": ("slide_mm\n1\nmany\n",)}, r"line 3: 'many' is not a value of slide"),
        ({"path": ("slide_mm\n1\n12\n",)}, r"line 3: 12 is outside the range of slide"),
        ({"path": ("slide_mm,frame\n,1\n",)}, "holds 0 states"),
    ],
)
def test_states_that_cannot_be_are_refused(choice, message, tmp_path):
    path = choice.get("path")
    if isinstance(path, tuple):
        (tmp_path / "path.csv").write_text(path[0])
        path = "path.csv"
    choice = StateChoice(**{**choice, "path": tmp_path / path if path else None})
    with pytest.raises(ExportError, match=message):
        choice.states(stretched_block_model())


@pytest.mark.parametrize(
    ("states", "message"),
    [
        ([[0.0, 0.02]], "state 0: 20 is outside the range of slide, -10 to 10 mm"),
        ([[0.0, 0.001], [np.nan, 0.0]], "state 1: nan is outside the range of stretch"),
        ([[0.0, 0.0, 0.0]], r"for each of the parameters \(stretch, slide\), not the shape \(1, 3\)"),
        (np.zeros((0, 2)), r"not the shape \(0, 2\)"),
        ([["a", "b"]], "states are a StateChoice, or an array"),
    ],
)
def test_arrays_of_states_that_cannot_be_are_refused_before_anything_is_written(states, message, tmp_path):
    with pytest.raises(ExportError, match=message):
        export(stretched_block_model(), tmp_path / "out", "vtu", states)
    assert not (tmp_path / "out").exists()


def test_formats_and_colours_that_do_not_exist_are_refused(tmp_path):
    with pytest.raises(ExportError, match="'csv' is no format of an export; these are xdmf, vtu, gltf"):
        export(stretched_block_model(), tmp_path / "out", "csv")  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match=r"holds no stres to show .* stress, strain, displacement"):
        export(stretched_block_model(), tmp_path / "out", "gltf", show="stres")  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_a_value_beside_a_column_of_it_is_refused(tmp_path):
    """It changed nothing."""
    table_of = tmp_path / "table.csv"
    table_of.write_text("slide [mm]\n1\n2\n")
    with pytest.raises(ExportError, match=r"--at slide changes nothing: .* has the column 'slide \[mm\]'"):
        StateChoice(path=table_of, at=["slide=2"]).states(stretched_block_model())
    found = StateChoice(path=table_of, at=["stretch=0.1"]).states(stretched_block_model())
    np.testing.assert_allclose(found, [[0.1, 0.001], [0.1, 0.002]])


def test_a_value_may_have_a_unit_of_its_own():
    states = StateChoice(vary=["slide=-1 cm:2mm:2"], at=["stretch=0.1"]).states(stretched_block_model())
    np.testing.assert_allclose(states, [[0.1, -0.01], [0.1, 0.002]])


def test_a_shorter_series_leaves_no_state_of_the_one_before(tmp_path):
    """What others wrote stays; a model in memory is called by its name."""
    model = replace(stretched_block_model(), name="a/b c")
    export(model, tmp_path, "vtu", np.zeros((3, 2)))
    for name in ("a_b_c_0007.vtu", "a_b_c_d_0002.vtu"):
        (tmp_path / name).write_text("of another program")
    assert export(model, tmp_path, "vtu", [0.1, 0.0]) == tmp_path / "a_b_c.pvd"
    expected = {"a_b_c.pvd", "a_b_c_0000.vtu", "a_b_c_0007.vtu", "a_b_c_d_0002.vtu", "states.csv"}
    assert {path.name for path in tmp_path.iterdir()} == expected


FILES = {"xdmf": {"NAME.xdmf", "NAME.h5"}, "vtu": {"NAME.pvd", "NAME_0000.vtu", "NAME_0001.vtu"}, "gltf": {"NAME.glb"}}


@pytest.mark.parametrize("before", FILES)
@pytest.mark.parametrize("after", FILES)
def test_an_export_replaces_the_one_before_in_whatever_format(before, after, tmp_path):
    """Of another model nothing is touched but the table."""
    model = stretched_block_model()
    export(replace(model, name="other"), tmp_path, before, np.zeros((2, 2)))
    kept = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name != "states.csv"}
    named = replace(model, name="block")
    export(named, tmp_path, before, np.zeros((2, 2)))
    export(named, tmp_path, after, np.zeros((2, 2)))
    left = {path.name for path in tmp_path.iterdir()} - {"states.csv"} - kept.keys()
    assert left == {name.replace("NAME", "block") for name in FILES[after]}
    assert kept == {name: (tmp_path / name).read_bytes() for name in kept}


@pytest.mark.parametrize("file_format", FILES)
def test_files_of_other_programs_stay_beside_an_export_of_their_name(file_format, tmp_path):
    """A series by meshio itself, a collection of other files, an animation without our mark."""
    names = {name.replace("NAME", "block") for form, files in FILES.items() if form != file_format for name in files}
    for name in names:
        (tmp_path / name).write_text('<DataSet file="others/block_0000.vtu"/><Grid Name="mine">block.h5:/data0</Grid>')
    export(replace(stretched_block_model(), name="block"), tmp_path, file_format, np.zeros((2, 2)))
    assert names < {path.name for path in tmp_path.iterdir()}


def test_a_model_without_parameters_has_no_path(tmp_path, refused):
    body = stretched_block_model()
    meshio.Mesh(body.nodes, [("triangle", body.triangles)]).write(tmp_path / "box.obj")
    build_rigid(tmp_path / "box.obj", "m", tmp_path / "box.morph")
    (tmp_path / "frames.csv").write_text("frame,x_mm\n0,1\n")
    options = ("-o", tmp_path / "out", "--path", tmp_path / "frames.csv")
    assert "has no parameters, and so one state only: leave --path out" in refused(
        "export", tmp_path / "box.morph", *options
    )


def test_a_folder_that_cannot_be_written_is_refused(folder, tmp_path, refused):
    (tmp_path / "file").write_text("")
    assert "cannot write to" in refused("export", folder / "block.morph", "-o", tmp_path / "file" / "out")


@pytest.mark.parametrize("name", ["R&D", '2" pipe', "a<b"])
def test_an_earlier_export_of_a_model_whose_name_xml_writes_otherwise_is_replaced(tmp_path, name):
    file = tmp_path / f"{name}.morph"
    save_model(file, stretched_block_model())
    for count in (6, 2):
        export(file, tmp_path / "out", "vtu", StateChoice(vary=[f"slide=-1:1:{count}"]))
    assert sorted(path.name for path in (tmp_path / "out").glob("*.vtu")) == [f"{name}_0000.vtu", f"{name}_0001.vtu"]
