"""Imports run one way, and every file says what it is: read from the source, nothing is imported."""

import ast
import math
import re
from pathlib import Path

import pytest

from caustic_cli.commands import console, parser
from caustic_cli.errors import MARK, InputError
from caustic_cli.schema.table import TABLE

PACKAGE = Path(__file__).resolve().parent.parent / "caustic_cli"
FILES = sorted(PACKAGE.rglob("*.py"))

#: What a room, a folder, may import from the package: commands -> workflow -> project -> kinds -> config -> inverse -> optics ->
#: scene -> the schema of settings, with studies and exports beside the inverse problem.  They write files and pictures, through io,
#: by which config reads project.toml.
BOTTOM = {"schema", "errors", "loading", "effort"}
ALLOWED = {
    "schema": BOTTOM,
    "scene": {"scene"} | BOTTOM,
    "optics": {"optics", "scene"} | BOTTOM,
    "inverse": {"inverse", "optics", "scene"} | BOTTOM,
    "io": {"io", "optics", "scene"} | BOTTOM,
    "export": {"export", "optics", "scene", "io"} | BOTTOM,
    "studies": {"studies", "optics", "scene", "io"} | BOTTOM,
    "config": {"config", "inverse", "io", "optics", "scene"} | BOTTOM,
    "kinds": {"kinds", "config", "inverse", "studies", "io", "optics", "scene"} | BOTTOM,
    "project": {"project", "kinds", "config", "inverse", "io", "optics", "scene"} | BOTTOM,
}
ALLOWED["workflow"] = {"workflow", "studies", "export"} | ALLOWED["project"]
#: Only the command line may import the command line.
TOP = {"cli", "__main__", "commands"}
#: What the package's top level holds, besides the rooms.
FRONT = {"__init__.py", "__main__.py", "cli.py", "effort.py", "errors.py", "loading.py"}
#: Files, formats and terminals: none of it below the command line's own modules.
OUTSIDE = {"typer", "rich", "click", "PIL", "h5py", "tomli_w", "tomllib", "json", "csv", "argparse", "matplotlib"}


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_in(tree: ast.AST, name: str, is_package: bool) -> set[str]:
    """Full names of all modules imported anywhere in a file, or on demand; for `from a import b` both a and a.b."""
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
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "OnDemand":
            found.add(ast.literal_eval(node.args[0]))
    return found


IMPORTS = {module_name(p): imports_in(ast.parse(p.read_text("utf-8")), module_name(p), p.name == "__init__.py") for p in FILES}


def part_of(module: str) -> str:
    """`optics` for caustic_cli.optics.trace, "" for the package itself."""
    return [*module.split("."), ""][1]


def own(imported: set[str]) -> set[str]:
    """Parts of the package among the imported names that are modules, the package's own version and name aside."""
    modules = {m for m in imported if m.startswith("caustic_cli.") and (m in IMPORTS or m.rpartition(".")[0] in IMPORTS)}
    return {part_of(m) for m in modules} - {"__version__"}


def test_the_reader_of_imports_sees_all_forms():
    source = (
        "import a.b\ndef f():\n    from caustic_cli.optics import trace\n    from . import x\n    from ..scene.lens import Lens\n"
    )
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
    assert len(modules) >= (1 if part == "completion" else 2)
    wrong = {m: sorted(own(IMPORTS[m]) - ALLOWED[part]) for m in modules if own(IMPORTS[m]) - ALLOWED[part]}
    assert not wrong


def test_the_top_level_holds_rooms():
    assert {p.name for p in PACKAGE.glob("*.py")} == FRONT
    assert {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"} == {*ALLOWED, "commands"}


@pytest.mark.parametrize(
    "path",
    [p for p in FILES if not {"commands", "cli.py", "table.py"} & set(p.relative_to(PACKAGE).parts)],
    ids=lambda p: str(p.relative_to(PACKAGE)),
)
def test_no_option_is_named_below_the_commands(path):
    """Parameters that a message speaks of are marked, and the command line says them as options (`errors.MARK`)."""
    assert not re.findall(r"(?<![\w-])--[a-z][\w-]*", path.read_text("utf-8"))


def test_compiled_loops_are_kernels():
    """The files that compile functions, read from their decorators."""
    compiled = {
        str(p.relative_to(PACKAGE).parent)
        for p in FILES
        if any(
            "njit" in ast.unparse(d)
            for node in ast.walk(ast.parse(p.read_text("utf-8")))
            if isinstance(node, ast.FunctionDef)
            for d in node.decorator_list
        )
    }
    assert compiled == {"optics/kernels"}


#: Calls that open a file by its name, or take an open one in its place, and methods of paths, figures, pictures and arrays that do.
OPENERS = {
    "open",
    "os.open",
    "io.open",
    "np.load",
    "np.loadtxt",
    "np.genfromtxt",
    "np.fromfile",
    "np.memmap",
    "np.save",
    "np.savez",
}
OPENERS |= {"np.savetxt", "np.savez_compressed", "Image.open", "h5py.File", "zipfile.ZipFile", "tomllib.load", "json.load"}
OPENERS |= {"torch.load", "torch.save", "shutil.copy", "shutil.copyfile", "shutil.move"}
METHODS = {"open", "read_text", "read_bytes", "write_text", "write_bytes", "save", "savefig", "tofile"}
#: Objects of the package with a method of such a name, which is itself looked at, and members of an open archive.
OWN_METHODS = {
    "Project.open",
    "checkpoint.save",
    "project.save",
    "self.project.save",
    "self.open",
    "self._zip.open",
    "archive.open",
}
#: What gives an open regular file, a new file or its temporary name, and files in memory.
SAFE = {"open_regular", "atomic_file", "atomic_path", "io.BytesIO", "_Bounded"}
#: The opener itself; files of the package; the null device and the standard streams; a directory, for its lock.
ELSEWHERE = {
    ("io/files.py", "open"),
    ("io/files.py", "os.open"),
    ("config/presets/__init__.py", "path.read_text"),
    ("scene/spectrum.py", "path.read_text"),
    ("export/page/__init__.py", "(here / f'page.{kind}').read_text"),
    ("optics/kernels/cache.py", "p.read_bytes"),
    ("optics/kernels/cache.py", "path.read_bytes"),
    ("optics/kernels/cache.py", "os.open"),
    ("io/picture.py", "open"),
    ("cli.py", "open"),
    ("cli.py", "os.open"),
    ("project/directory.py", "os.open"),
}


def opened_in(tree: ast.AST) -> set[str]:
    """Names of the calls of a file that open another one, except those of what is open or in memory already: a call in SAFE, a name
    that is bound to one or annotated as a file, or a method of an opened picture or figure with such an argument."""
    safe = {
        item.optional_vars.id
        for node in ast.walk(tree)
        if isinstance(node, ast.With)
        for item in node.items
        if isinstance(item.optional_vars, ast.Name) and isinstance(item.context_expr, ast.Call)
        if ast.unparse(item.context_expr.func) in SAFE
    }
    safe |= {
        node.targets[0].id
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and isinstance(node.value, ast.Call)
        if ast.unparse(node.value.func) in SAFE
    }
    safe |= {
        node.arg
        for node in ast.walk(tree)
        if isinstance(node, ast.arg) and node.annotation is not None and "IO" in ast.unparse(node.annotation)
    }
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            by_method = isinstance(node.func, ast.Attribute) and node.func.attr in METHODS and name not in OWN_METHODS
            of = node.args[0] if node.args else None
            given = (isinstance(of, ast.Name) and of.id in safe) or (isinstance(of, ast.Call) and ast.unparse(of.func) in SAFE)
            if (name in OPENERS or by_method) and not given:
                found.add(name)
    return found


def test_the_reader_of_openers_sees_them():
    bad = "with open(a) as f: pass\nImage.open(path)\nnp.load(io.open(p))\nfigure.savefig(path)\nPath(x).read_bytes()\n"
    assert opened_in(ast.parse(bad)) == {"open", "Image.open", "io.open", "np.load", "figure.savefig", "Path(x).read_bytes"}
    good = (
        "with open_regular(p, '', 9) as f:\n    Image.open(f)\nnp.save(io.BytesIO(), a)\ndef g(file: BinaryIO): h5py.File(file)\n"
    )
    assert opened_in(ast.parse(good)) == set()


def test_files_are_opened_in_one_place():
    """Names that a user gives reach the operating system through `io.files` alone, which opens regular files only."""
    found = {(str(p.relative_to(PACKAGE).as_posix()), name) for p in FILES for name in opened_in(ast.parse(p.read_text("utf-8")))}
    assert found == ELSEWHERE


def test_nobody_imports_the_command_line_but_itself():
    assert not [m for m, i in IMPORTS.items() if part_of(m) not in TOP and own(i) & {"cli", "commands"}]
    assert "commands" in own(IMPORTS["caustic_cli.cli"])
    assert "cli" not in set().union(*(own(i) for m, i in IMPORTS.items() if part_of(m) == "commands"))


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


def test_marks_name_settings(capfd):
    """Every mark in the sources is a path of the table, or an option of some command that no setting is."""
    options = {o for c in parser.parser().commands.values() for p in c.params for o in p.opts if o.startswith("--")}
    advised = {name[1:] for p in FILES for name in MARK.findall(p.read_text("utf-8")) if name.startswith("+")}
    assert advised and all(TABLE[path].option for path in advised)
    marked = {name.lstrip("+") for p in FILES if p.name != "errors.py" for name in MARK.findall(p.read_text("utf-8"))}
    paths = {name.replace("source.also.", "source.") for name in marked if "." in name and not name.endswith(("_", "."))}
    assert len(paths) > 30 and paths <= set(TABLE)
    named = {
        name: TABLE[name].option.name if name in TABLE else "--" + name.replace("_", "-") for name in marked if "." not in name
    }
    assert {*named.values()} <= options


def test_a_message_names_the_option_that_said_it(capfd):
    """The library names settings as project.toml does; the command line the option, where one was used."""
    error = InputError("⟨lens.size⟩ must be a pair; a larger ⟨mag⟩ will do")
    assert str(error) == "[lens] size must be a pair; a larger mag will do"
    assert f"{InputError(f'x: {error}')}" == f"x: {error}"
    for spoken, words in (({}, "[lens] size"), ({"lens.size": "--lens-size"}, "--lens-size")):
        console.set_option_names(spoken)
        console.error(f"{error}")
        assert capfd.readouterr().err == f"caustic: {words} must be a pair; a larger --mag will do\n"


@pytest.mark.parametrize("row", TABLE.values(), ids=lambda row: row.path)
def test_every_setting_says_what_it_is(row):
    """Each has a meaning, a default or how it follows, and accepts its own default."""
    assert row.help and not row.help[0].isspace() and not row.help.endswith(".")
    if row.default is not None and not (isinstance(row.default, float) and math.isinf(row.default)):
        row.check(row.default)
    if row.option and not row.option.common:
        for name in row.option.commands:
            options = {o: p for p in parser.parser().commands[name].params for o in p.opts}
            assert row.option.name in options


def test_no_message_spells_a_setting():
    """Below the commands, settings are named by their marks alone."""
    spelled = re.compile(r"\[\[?(?:source|lens|screen|target|design|design\.stages)\]\]? (\w+)")
    wrong = []
    for path in FILES:
        if {"commands", "cli.py"} & set(path.relative_to(PACKAGE).parts):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Raise):
                wrong += [
                    (path.name, m[0]) for m in spelled.finditer(ast.unparse(node)) if m[1] in {row.key for row in TABLE.values()}
                ]
    assert not wrong
