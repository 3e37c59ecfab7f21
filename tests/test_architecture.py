"""Imports run one way, and every file says what it is: read from the source, nothing is imported."""

import ast
import re
from pathlib import Path

import pytest

from caustic_cli import cli
from caustic_cli.commands import console
from caustic_cli.errors import MARK, InputError

PACKAGE = Path(__file__).resolve().parent.parent / "caustic_cli"
FILES = sorted(PACKAGE.rglob("*.py"))

#: What a room may import from the package: commands -> workflow -> project -> config -> inverse -> optics -> scene -> errors, with
#: studies and exports beside the inverse problem.  They write files and pictures, through io; nothing else below the project does.
ALLOWED = {
    "scene": {"scene", "errors"},
    "optics": {"optics", "scene", "errors"},
    "inverse": {"inverse", "optics", "scene", "errors"},
    "io": {"io", "optics", "scene", "errors"},
    "export": {"export", "optics", "scene", "errors", "io"},
    "studies": {"studies", "optics", "scene", "errors", "io"},
    "config": {"config", "inverse", "optics", "scene", "errors"},
    "project": {"project", "config", "inverse", "io", "optics", "scene", "errors"},
    "workflow": {"workflow", "project", "config", "inverse", "studies", "export", "io", "optics", "scene", "errors"},
}
#: Only the command line may import the command line.
TOP = {"cli", "__main__", "commands"}
#: What the package's top level holds, besides the rooms.
FRONT = {"__init__.py", "__main__.py", "cli.py", "errors.py"}
#: Files, formats and terminals: none of it below the command line's own modules.
OUTSIDE = {"typer", "rich", "click", "PIL", "h5py", "tomli_w", "tomllib", "json", "csv", "argparse", "matplotlib"}


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_in(tree: ast.AST, name: str, is_package: bool) -> set[str]:
    """Full names of all modules imported anywhere in a file; for `from a import b` both a and a.b."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = name.split(".")[: None if is_package and node.level == 1 else -(node.level - is_package)]
                base = ".".join([*parents, *([base] if base else [])])
            found |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    return found


IMPORTS = {module_name(p): imports_in(ast.parse(p.read_text("utf-8")), module_name(p), p.name == "__init__.py") for p in FILES}


def part_of(module: str) -> str:
    """`optics` for caustic_cli.optics.trace, `files` for caustic_cli.io.files, "" for the package itself."""
    return [*module.split("."), ""][1]


def own(imported: set[str]) -> set[str]:
    """Parts of the package among the imported names that are modules, the package's own version and name aside."""
    modules = (m for m in imported if m.startswith("caustic_cli.") and (m in IMPORTS or m.rpartition(".")[0] in IMPORTS))
    return {part_of(m) for m in modules} - {"__version__"}


def test_the_reader_of_imports_sees_all_forms():
    source = ("import a.b\ndef f():\n    from caustic_cli.optics import trace\n"
              "    from . import x\n    from ..scene.lens import Lens\n")
    found = imports_in(ast.parse(source), "caustic_cli.inverse.losses", False)
    assert {"a.b", "caustic_cli.optics.trace", "caustic_cli.inverse.x", "caustic_cli.scene.lens"} <= found
    assert "caustic_cli.inverse.x" in imports_in(ast.parse("from . import x"), "caustic_cli.inverse", True)


def test_there_is_something_to_check():
    parts = {part_of(m) for m in IMPORTS}
    assert set(ALLOWED) <= parts
    assert len(IMPORTS) > 20
    edges = [(m, o) for m, imported in IMPORTS.items() for o in own(imported) if o != part_of(m)]
    assert len(edges) > 30
    expected = {("optics", "scene"), ("inverse", "optics"), ("export", "optics"), ("studies", "optics")}
    assert expected <= {(part_of(m), o) for m, o in edges}


@pytest.mark.parametrize("part", ALLOWED)
def test_imports_run_one_way(part):
    modules = [m for m in IMPORTS if part_of(m) == part]
    assert len(modules) >= 3
    wrong = {m: sorted(own(IMPORTS[m]) - ALLOWED[part]) for m in modules if own(IMPORTS[m]) - ALLOWED[part]}
    assert not wrong


def test_the_top_level_holds_rooms():
    assert {p.name for p in PACKAGE.glob("*.py")} == FRONT
    assert {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"} == {*ALLOWED, "commands"}


@pytest.mark.parametrize("path", [p for p in FILES if not {"commands", "cli.py"} & set(p.relative_to(PACKAGE).parts)],
                         ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_option_is_named_below_the_commands(path):
    """Parameters that a message speaks of are marked, and the command line says them as options (`errors.MARK`)."""
    assert not re.findall(r"(?<![\w-])--[a-z][\w-]*", path.read_text("utf-8"))


def test_compiled_loops_are_kernels():
    """The files that compile functions, read from their decorators."""
    compiled = {str(p.relative_to(PACKAGE).parent) for p in FILES if any(
        "njit" in ast.unparse(d) for node in ast.walk(ast.parse(p.read_text("utf-8"))) if isinstance(node, ast.FunctionDef)
        for d in node.decorator_list)}
    assert compiled == {"optics/kernels"}


def test_nobody_imports_the_command_line_but_itself():
    assert not [m for m, i in IMPORTS.items() if part_of(m) not in TOP and own(i) & {"cli", "commands"}]
    assert "commands" in own(IMPORTS["caustic_cli.cli"])
    shown = "caustic_cli.commands.manpage"  # of which the whole parser is the subject
    assert "cli" not in set().union(*(own(i) for m, i in IMPORTS.items() if part_of(m) == "commands" and m != shown))


@pytest.mark.parametrize("part", ["scene", "optics", "inverse"])
def test_physics_knows_no_files_and_no_terminal(part):
    checked = 0
    for module, imported in IMPORTS.items():
        if part_of(module) == part:
            roots = {m.split(".")[0] for m in imported}
            assert not roots & OUTSIDE, module
            checked += len(roots)
    assert checked > 10


def test_scene_and_bare_errors_need_no_torch():
    """The scene is plain data: the command line validates it before anything heavy is loaded."""
    modules = [m for m in IMPORTS if part_of(m) in {"scene", "errors"}]
    assert len(modules) > 5
    assert not [m for m in modules if any(i.split(".")[0] in {"torch", "scipy"} for i in IMPORTS[m])]


def test_no_two_modules_import_each_other():
    """A depth-first search over all imports, those inside functions included; packages' own __init__ files are only fronts."""
    graph = {m: {i for i in imported if i in IMPORTS and i != m and not m.startswith(i + ".")} for m, imported in IMPORTS.items()}
    done, cycles = set(), []

    def visit(module: str, path: tuple[str, ...]) -> None:
        if module in path:
            cycles.append(path[path.index(module) :])
        elif module not in done:
            for other in sorted(graph[module]):
                visit(other, (*path, module))
            done.add(module)

    for module in sorted(graph):
        visit(module, ())
    assert not cycles
    assert sum(map(len, graph.values())) > 40


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_say_what_they_are(path):
    text = path.read_text("utf-8")
    assert ast.get_docstring(ast.parse(text))


def test_marked_parameters_are_options(capfd):
    """Every mark in the sources names an option of some command; a library's reader sees the name alone."""
    options = {o for c in cli.parser().commands.values() for p in c.params for o in p.opts if o.startswith("--")}
    marked = {name for p in FILES if p.name != "errors.py" for name in MARK.findall(p.read_text("utf-8"))}
    assert len(marked) > 20 and {"--" + name.replace("_", "-") for name in marked} <= options
    error = InputError("⟨screen_size⟩ must be one or two lengths")
    assert str(error) == "screen_size must be one or two lengths" and f"{InputError(f'x: {error}')}" == f"x: {error}"
    console.error(f"{error}")
    assert capfd.readouterr().err == "caustic: --screen-size must be one or two lengths\n"
