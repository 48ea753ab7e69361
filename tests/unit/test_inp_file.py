"""Abaqus and CalculiX input files, written here, give back the numbers that were put into them."""

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.io.inp_file import read_inp

CUBE = """*HEADING
two cubes, mm
** a comment
*Node, nset=NALL
 1, 0., 0., 0.
 2, 10., 0., 0.
 3, 10., 10., 0.
 4, 0., 10., 0.
 11, 0., 0., 10.
 12, 10., 0., 10.
 13, 10., 10., 10.
 14, 0., 10., 1.0D+1
 21, 0, 0, 20
 22, 10, 0, 20
 23, 10, 10, 20
 24, 0, 10, 20
 99, 5, 5, 50
*ELEMENT, TYPE=C3D8R, ELSET=Lower
 7, 1, 2, 3, 4, 11, 12, 13, 14
*ELEMENT, TYPE=C3D8I, ELSET=Upper
 9, 11, 12, 13, 14, 21,
 22, 23, 24
"""
CARDS = """*NSET, NSET=Bottom
1, 2, 3
4,
*NSET, NSET=Top, GENERATE
21, 24, 1
*NSET, NSET=Ends
top, Bottom
11
*NSET, NSET=fromElements, ELSET=LOWER
*ELSET, ELSET=Both
Lower, 9
*SURFACE, NAME=Pressed, TYPE=ELEMENT
Upper, S2
7, S1
*SURFACE, TYPE=NODE, NAME=Held
Bottom,
*SOLID SECTION, ELSET=Lower, MATERIAL=rubber
*MATERIAL, NAME=rubber
*HYPERELASTIC, MOONEY-RIVLIN
0.5, 0.1, 2e-3
*STEP
*STATIC
*BOUNDARY
Bottom, 1, 3
*END STEP
"""


@pytest.fixture
def write(tmp_path):
    def to_file(text, name="part.inp"):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return to_file


def test_nodes_and_elements_are_read_with_continuation_lines(write):
    part = read_inp(write(CUBE))
    np.testing.assert_array_equal(part.node_labels, [1, 2, 3, 4, 11, 12, 13, 14, 21, 22, 23, 24, 99])
    np.testing.assert_array_equal(part.nodes[7], [0, 10, 10])
    assert [e.cell_type for e in part.elements] == ["hex8", "hex8"]
    np.testing.assert_array_equal(part.elements[1].labels, [9])
    np.testing.assert_array_equal(part.elements[1].connectivity, [[11, 12, 13, 14, 21, 22, 23, 24]])


def test_sets_are_lists_ranges_sets_of_sets_and_the_nodes_of_elements(write):
    part = read_inp(write(CUBE + CARDS))
    sets = {name: labels.tolist() for name, labels in part.node_sets.items()}
    assert sets.pop("NALL") == [1, 2, 3, 4, 11, 12, 13, 14, 21, 22, 23, 24, 99]
    assert sets == {
        "Bottom": [1, 2, 3, 4],
        "Top": [21, 22, 23, 24],
        "Ends": [1, 2, 3, 4, 11, 21, 22, 23, 24],
        "fromElements": [1, 2, 3, 4, 11, 12, 13, 14],
        "Held": [1, 2, 3, 4],
    }
    assert {name: labels.tolist() for name, labels in part.element_sets.items()} == {
        "Lower": [7], "Upper": [9], "Both": [7, 9],
    }  # fmt: skip
    assert [(p.elements.tolist(), p.face) for p in part.surfaces["Pressed"]] == [([9], "S2"), ([7], "S1")]


def test_nodes_in_a_plane_have_height_zero(write):
    text = "*NODE\n1, 0, 0\n2, 1, 0\n3, 1, 1\n4, 0, 1\n*ELEMENT, TYPE=S4R, ELSET=E\n1, 1, 2, 3, 4\n"
    part = read_inp(write(text))
    assert part.elements[0].cell_type == "quad4"
    np.testing.assert_array_equal(part.nodes[2], [1, 1, 0])


def test_included_files_stand_in_place_and_are_named_in_errors(write):
    write(CUBE, "mesh.inc")
    part = read_inp(write("*INCLUDE, INPUT=mesh.inc\n" + CARDS))
    assert part.node_sets["Top"].tolist() == [21, 22, 23, 24]
    write(CUBE.replace("10., 0., 0.", "10., O., 0."), "mesh.inc")
    with pytest.raises(StudyError, match=r"mesh\.inc, line 6: 'O\.' is not a number"):
        read_inp(write("*INCLUDE, INPUT=mesh.inc\n" + CARDS))
    write("*INCLUDE, INPUT=part.inp\n", "mesh.inc")
    with pytest.raises(StudyError, match=r"mesh\.inc, line 1: .*part\.inp includes itself"):
        read_inp(write("*INCLUDE, INPUT=mesh.inc\n"))
    with pytest.raises(StudyError, match=r"part\.inp, line 1: the included file .*none\.inc is not there"):
        read_inp(write("*INCLUDE, INPUT=none.inc\n"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CUBE.replace("C3D8R", "C3D5"), "line 18: element type C3D5 is not known; use C3D4, "),
        (CUBE.replace("TYPE=C3D8R", "TYPE=B31"), "line 18: element type B31 is not known"),
        (CUBE.replace("*ELEMENT, TYPE=C3D8R,", "*ELEMENT,"), r"line 18: \*ELEMENT lacks its parameter TYPE="),
        (CUBE.replace(" 7, 1, 2", " 7, 1, 55"), "line 19: element 7 refers to node 55"),
        (CUBE.replace("\n 22, 23, 24", ""), "line 21: element 9 ends after 5 of its 8 nodes"),
        (CUBE.replace(" 22, 23, 24", " 22, 23, 24, 99"), "line 21: element 9 has 9 nodes; a hex8 has 8"),
        (CUBE.replace(" 9, 11", " 7, 11"), "line 21: element 7 was defined before"),
        (CUBE.replace(" 2, 10., 0., 0.", " 2, 10."), "line 6: a node needs a label and two"),
        (CUBE.replace(" 2, 10., 0., 0.", " 2, 1e999, 0, 0"), "line 6: '1e999' is not a finite number"),
        (CUBE.replace(" 24, 0, 10, 20", " 23, 0, 10, 20"), "line 16: node 23 was given other"),
        (CUBE[:300], "element 7 ends after|holds no elements|a node needs"),
        (CUBE[: CUBE.index("*ELEMENT")], "holds no elements; it is no mesh, or is cut short"),
        ("1, 2, 3\n", "line 1: the file begins with data"),
        ("*NODE, SYSTEM=C\n1, 2, 3, 4\n", r"line 1: \*NODE with SYSTEM="),
        (CUBE + "*NGEN\n1, 5, 1\n", r"line 23: \*NGEN is not read"),
        (CUBE + "*INSTANCE, NAME=a, PART=b\n0., 0., 5.\n", "line 23: assemblies of placed instances"),
        (CUBE + "*NSET, NSET=a\n1, 77\n", "line 24: node 77 in 'a' is not defined"),
        (CUBE + "*NSET, NSET=a\nLowest\n", "line 24: there is no node set 'Lowest'"),
        (CUBE + "*NSET, NSET=a\nb\n*NSET, NSET=b\na\n", "holds itself"),
        (CUBE + "*NSET, NSET=a, GENERATE\n5, 1, 1\n", "line 24: 5, 1, 1 is no range"),
        (CUBE + "*NSET, NSET=a, GENERATE\n5\n", "line 24: a GENERATE line needs"),
        (CUBE + "*SURFACE, NAME=s\nLower, S7\n", "line 24: 'S7' is no face"),
        (CUBE + "*SURFACE, NAME=s, TYPE=CUTTING SURFACE\nLower, S7\n", "line 23: a surface of type CUTTING"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_file_and_line(write, text, message):
    with pytest.raises(StudyError, match=rf"part\.inp.*({message})"):
        read_inp(write(text))


def test_a_part_and_its_one_instance_are_read_as_flat(write):
    head, mesh = CUBE.split("*Node", 1)
    part = f"{head}*Part, name=P\n*Node{mesh}*End Part\n*Assembly, name=A\n*Instance, name=P-1, part=P\n"
    sets = "*End Instance\n*Nset, nset=Held, instance=P-1\n 1, 2,\n*Elset, elset=_s_S2, internal\n 9,\n"
    whole = read_inp(write(f"{part}{sets}*Surface, type=ELEMENT, name=s\n_s_S2, S2\n*End Assembly\n"))
    assert whole.node_sets["Held"].tolist() == [1, 2]
    assert [(p.elements.tolist(), p.face) for p in whole.surfaces["s"]] == [([9], "S2")]


def test_a_missing_or_binary_file_is_refused(tmp_path):
    with pytest.raises(StudyError, match="cannot read the mesh"):
        read_inp(tmp_path / "none.inp")
    (tmp_path / "odb.inp").write_bytes(b"\x00\x01\x02")
    with pytest.raises(StudyError, match="is not a text file"):
        read_inp(tmp_path / "odb.inp")


def test_a_file_cut_anywhere_never_escapes_as_another_error(write):
    whole, messages = CUBE + CARDS, []
    for length in range(0, len(whole), 7):
        try:
            read_inp(write(whole[:length]))
        except StudyError as error:
            messages.append(str(error))
    assert len(messages) > len(CUBE) / 7 - 12  # whole at the end of the first elements alone
    assert all("part.inp" in message for message in messages)
