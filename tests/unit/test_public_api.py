"""The names that scripts may rely on: they exist, cost nothing until they are used, and examples need no others."""

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import morph_dslam as md
from morph_dslam import extend
from tests.support.documents import PROJECT

#: Packages that take long to load.
HEAVY = ("ngsolve", "cv2", "numba", "numpy", "matplotlib", "websockets", "rerun", "rclpy")
#: An import of what is not public.
INNER = re.compile(r"^\s*(?:from|import) morph_dslam\.(?!extend\b)[a-z_.]+.*", re.MULTILINE)
#: What the command line may import beside public names: itself, its errors and its version.
OF_THE_COMMAND_LINE = re.compile(r"from morph_dslam\.(cli[a-z_.]*|errors|_version) import ")


def inner_imports(folder):
    files = (PROJECT / folder).rglob("*.py")
    return [(path.name, line.strip()) for path in files for line in INNER.findall(path.read_text())]


def test_examples_import_public_names_only():
    assert inner_imports("examples") == []
    assert len(inner_imports("benchmarks")) <= 40


def test_the_command_line_does_what_a_script_can_do():
    inner = inner_imports("src/morph_dslam/cli")
    assert len(inner) > 10
    assert [found for found in inner if not OF_THE_COMMAND_LINE.match(found[1])] == []


def test_there_are_few_public_names():
    assert 15 <= len(md.__all__) <= 45
    assert list(md.__all__) == sorted(md.__all__)
    assert set(md.__all__) <= set(dir(md))
    assert Path(md.__file__).with_name("py.typed").is_file()
    # An import of such a module would hide the name.
    modules = {module.name for module in pkgutil.iter_modules(md.__path__)}
    assert modules & set(md.__all__) == set()


#: The modules of building blocks.
EXTEND = sorted(path.stem for path in Path(extend.__file__).parent.glob("[a-z]*.py"))


def test_a_path_may_be_a_string_wherever_a_path_is_taken():
    modules = [md, *(importlib.import_module(f"morph_dslam.extend.{name}") for name in EXTEND)]
    functions = [f for module in modules for f in map(module.__dict__.get, dir(module)) if inspect.isfunction(f)]
    assert len(functions) > 50
    for function in functions:
        for name, parameter in inspect.signature(function).parameters.items():
            assert parameter.annotation not in ("Path", "Path | None"), f"{function.__name__}({name})"


@pytest.mark.parametrize("name", EXTEND)
def test_building_blocks_are_listed_and_documented(name):
    module = importlib.import_module(f"morph_dslam.extend.{name}")
    assert f"`extend.{name}`" in str(extend.__doc__)
    _, *imports = ast.parse(inspect.getsource(module)).body
    found = [each for node in imports if isinstance(node, ast.ImportFrom) for each in node.names]
    # The form in which type checkers take an imported name for public.
    assert found
    assert [
        each.name for each in found if each.asname != each.name or not inspect.getdoc(getattr(module, each.name))
    ] == []


@pytest.mark.parametrize("package", [md, extend])
def test_every_public_name_is_documented_and_known_to_type_checkers(package):
    """The imports under TYPE_CHECKING name the same things from the same modules."""
    for name in package.__all__:
        assert inspect.getdoc(getattr(package, name)), name
    (block,) = (node for node in ast.parse(Path(package.__file__).read_text()).body if isinstance(node, ast.If))
    imports = [node for node in ast.walk(block) if isinstance(node, ast.ImportFrom)]
    typed = {name.asname or name.name: node.module for node in imports for name in node.names}
    assert typed == {name: f"morph_dslam.{module}" for name, module in package._MODULES.items()}
    assert set(typed) == set(package.__all__)


def test_paths_may_be_given_as_text():
    functions = [value for name in md.__all__ if inspect.isfunction(value := getattr(md, name))]
    assert len(functions) > 10
    for function in functions:
        for parameter in inspect.signature(function).parameters.values():
            kinds = re.split(r"[\[\]| ]+", str(parameter.annotation))
            assert ("Path" in kinds) <= ("str" in kinds), f"{function.__name__}({parameter})"


def test_a_name_that_does_not_exist_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no_such_name"):
        md.no_such_name  # noqa: B018


@pytest.mark.parametrize("module", ["morph_dslam", "morph_dslam.extend"])
def test_importing_the_package_loads_nothing_heavy(module):
    program = f"import sys, {module}; print(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
