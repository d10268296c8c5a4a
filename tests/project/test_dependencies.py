"""Which module may import which, read from the source (docs/explanation/design.md).

Every folder and module has a level. A module may import modules of its own level and of lower
levels. There are no circular imports. A few libraries may only be imported in one place each.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = {
    "vslam": "vslam",
    "frontend": "vslam.frontend",
    "loopclosure": "vslam.loopclosure",
    "backend": "vslam.backend",
    "tools/vslam_lab": "vslam_lab",
}
# The lowest level comes first. A module belongs to the longest of these names that is a prefix of
# its name. Names on one level may not import each other, except as listed in SIBLINGS.
LEVELS: tuple[tuple[str, ...], ...] = (
    (
        "vslam.support",
        "vslam.types",
        "vslam.method",
        "vslam.support.errors",
        "vslam.support.machine",
        "vslam.method.version",
        "vslam.support.workers",
    ),
    (
        "vslam.support.kernels",
        "vslam.support.plugins",
        "vslam.support.untrusted",
        "vslam.support.lock_file",
        "vslam.support.file_kinds",
        "vslam.support.options",
    ),
    (
        "vslam.config",
        "vslam.types.geometry",
        "vslam.support.ransac",
        "vslam.types.camera",
        "vslam.types.source_options",
    ),
    ("vslam.types.odometry", "vslam.types.context", "vslam.types.imu"),
    ("vslam.types.features",),
    (
        "vslam.types.loops",
        "vslam.types.reprojection",
        "vslam.types.image_motion",
        "vslam.types.trajectory",
        "vslam.types.map_kernels",
        "vslam.calibration",
    ),
    ("vslam.types.revisits", "vslam.types.track"),
    ("vslam.types.map", "vslam.types.frame_poses", "vslam.types.states"),
    ("vslam.types.map_view", "vslam.method.shared_map"),
    ("vslam.frontend", "vslam.backend", "vslam.loopclosure", "vslam.datasets", "vslam.maps"),
    ("vslam.method.gyro",),
    ("vslam.method.hypotheses", "vslam.method.inertia"),
    ("vslam.method.starter", "vslam.method.closing", "vslam.method.motion"),
    ("vslam.method.map_frames", "vslam.method.gaps", "vslam.method.recent_frames"),
    ("vslam.method.published_map", "vslam.method.joining"),
    ("vslam.method.mapping",),
    ("vslam.method.modes",),
    ("vslam.method.session",),
    ("vslam.slam",),
    ("vslam.run",),
    ("vslam.evaluation",),
    ("vslam.report",),
    ("vslam.doctor",),
    ("vslam.cli",),
    ("vslam.__main__", "vslam"),
    ("vslam_lab", "vslam_lab.towns"),
    ("vslam_lab.sources", "vslam_lab.precision_recall"),
    ("vslam_lab.overview", "vslam_lab.bench", "vslam_lab.loopbench", "vslam_lab.training"),
    ("vslam_lab.stress",),
    ("vslam_lab.cli",),
)
# Allowed imports within a level, by module. The verification of loops matches features,
# aligns patches and optimises poses like tracking.
SIBLINGS = {
    ("vslam.loopclosure.evidence", "vslam.frontend.matching"),
    ("vslam.loopclosure.verification", "vslam.frontend.matching"),
    ("vslam.loopclosure.verification", "vslam.frontend.pose"),
    ("vslam.loopclosure.learned_alignment", "vslam.frontend.alignment"),
    ("vslam.loopclosure.learned_alignment", "vslam.frontend.pose"),
    ("vslam.loopclosure.learned_localisation", "vslam.frontend.pnp"),
    ("vslam.loopclosure.learned_localisation", "vslam.frontend.pose"),
}
# A benchmark starts the command line in separate processes, which only return files.
STARTED = {
    ("vslam_lab.bench.execute", "vslam_lab.cli.child"),
    ("vslam_lab.cli.cells", "vslam_lab.cli.child"),
    ("vslam_lab.loopbench.cost", "vslam_lab.loopbench.cost"),
    ("vslam.run.warmup", "vslam.run.toy_room"),
}
ONLY_IN = {
    "torch": "vslam_lab.training",
    "torchvision": "vslam_lab.training",
    "onnx": ("vslam_lab.training.export", "vslam.loopclosure.siamese.onnx_limits"),
    "safetensors": "vslam_lab.training.siamese",
    "onnxruntime": "vslam.loopclosure.siamese.inference",
    "gtsam": "vslam.backend",
    "rerun": "vslam.run.recorder",
    "evo": "vslam.evaluation.trajectories",
    "distributed": "vslam_lab.bench.cluster",
    "rosbags": ("vslam.datasets.bag_files", "vslam.datasets.bag_limits", "vslam.maps.ros"),
    "mcap": ("vslam.datasets.bag_files", "vslam.datasets.bag_limits"),
    "mcap_protobuf": "vslam.datasets.bag_files",
    "pymap3d": "vslam.datasets.fixes",
    "PIL": ("vslam.datasets.image_folders", "vslam.datasets.auto_calibration"),
    "pyorbslam3": "vslam_lab.stress.orbslam3",
    "deflate": "vslam.datasets.png",
    "typer": ("vslam.cli", "vslam_lab.cli"),
}

TRAINING = "vslam_lab.training"
# Imports torch inside its functions, after it has checked that torch is installed.
TRAINING_COMMANDS = "vslam_lab.cli.train"


def sources() -> dict[str, Path]:
    found = {}
    for folder, package in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((package, *(p for p in parts if p != "__init__")))] = path
    return found


def within(module: str, package: str) -> bool:
    return module == package or module.startswith(package + ".")


def imports_of(source: str, module: str = "", *, package: bool = False) -> set[str]:
    """Return the absolute names of all imports, including those in functions."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = module.split(".")
                parents = parents[: len(parents) - node.level + package]
                base = ".".join([*parents, *([base] if base else [])])
            names.add(base)
            names.update(f"{base}.{alias.name}" for alias in node.names)
    return names


def modules_of(names: set[str], known: set[str]) -> set[str]:
    """Return the modules among imported names.

    ``from a.b import c`` needs the module a.b. If c is itself a module, a.b is only its package and
    does not count.
    """
    found = names & known
    parents = {
        name
        for name in found
        if (inside := {n for n in names if n.rpartition(".")[0] == name}) and inside <= known
    }
    return found - parents


SOURCES = sources()
IMPORTS = {
    module: imports_of(path.read_text(), module, package=path.name == "__init__.py")
    for module, path in SOURCES.items()
}
ARROWS = {module: modules_of(names, set(SOURCES)) for module, names in IMPORTS.items()}


def level_of(module: str) -> tuple[int, str]:
    """Return the level of a module, and the name in the table of levels to which it belongs."""
    names = [(name, k) for k, level in enumerate(LEVELS) for name in level if within(module, name)]
    name, level = max(names, key=lambda found: len(found[0]))
    return level, name


def upward(arrows: dict[str, set[str]]) -> list[str]:
    """Return the imports that lead to a higher level, or that are not allowed within a level."""
    wrong = []
    for module, targets in arrows.items():
        level, place = level_of(module)
        for target in targets:
            target_level, target_place = level_of(target)
            across = target_level == level and place != target_place
            if target_level > level or (across and (module, target) not in SIBLINGS):
                wrong.append(f"{module} -> {target}")
    return wrong


def circle(arrows: dict[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_the_reader_of_imports_sees_every_form():
    source = (
        "import a.b\nfrom c import d\nfrom . import e\nfrom ..f import g\n"
        "def h():\n    import i\nif x:\n    from j.k import l as m\n"
    )
    found = imports_of(source, "p.q.r")
    assert found == {"a.b", "c", "c.d", "p.q", "p.q.e", "p.f", "p.f.g", "i", "j.k", "j.k.l"}
    known = {"a", "a.b", "c"}
    assert modules_of({"a", "a.b", "c", "c.D"}, known) == {"a.b", "c"}
    assert modules_of({"a", "a.b", "a.D"}, known) == {"a", "a.b"}
    assert modules_of({"a"}, known) == {"a"}


def test_the_modules_and_their_imports_are_found():
    assert {"vslam.frontend", "vslam.loopclosure", "vslam.backend", "vslam.cli"} <= set(SOURCES)
    assert "vslam.types.map_view" in ARROWS["vslam.frontend.tracking"]
    assert "vslam.frontend.tracker" in ARROWS["vslam.method.session"]
    assert "vslam_lab.bench.execute" in ARROWS["vslam_lab.cli.bench"]


def test_every_place_on_a_level_exists_and_every_module_has_one():
    places = {name for level in LEVELS for name in level}
    assert places <= set(SOURCES)
    loose = {m for m in SOURCES if level_of(m)[1] == "vslam"} - {"vslam"}
    assert loose == set()


def test_no_import_leads_up():
    assert upward(ARROWS) == []


def test_the_product_never_imports_the_laboratory():
    users = {m for m, names in IMPORTS.items() if any(within(name, "vslam_lab") for name in names)}
    assert {m for m in users if not within(m, "vslam_lab")} == set()


def test_no_circle_of_imports():
    assert circle(ARROWS) == []


def test_an_upward_import_and_a_circle_would_be_seen():
    assert upward({"vslam.types.map": {"vslam.slam"}}) == ["vslam.types.map -> vslam.slam"]
    assert upward({"vslam.backend.fusion": {"vslam.frontend.orb"}})
    assert upward({"vslam.cli.console": {"vslam_lab.bench.table"}})
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"a"}})) == {"a", "b", "c"}


def test_no_module_is_started_by_name_from_below():
    """``python -m vslam.x`` imports a module without an import statement."""
    started = {
        (module, name)
        for module, path in SOURCES.items()
        for name in re.findall(r'"-m", "([a-z_.]+)"', path.read_text())
    }
    assert started == STARTED


def test_every_granted_sibling_is_used():
    unused = {(a, b) for a, b in SIBLINGS if b not in ARROWS[a]}
    assert unused == set()


@pytest.mark.parametrize("library", sorted(ONLY_IN))
def test_heavy_libraries_stay_where_they_belong(library):
    users = {m for m, names in IMPORTS.items() if any(within(name, library) for name in names)}
    places = ONLY_IN[library] if isinstance(ONLY_IN[library], tuple) else (ONLY_IN[library],)
    assert {m for m in users if not any(within(m, place) for place in places)} == set()
    assert users or library == "torchvision"


def test_only_training_reaches_the_libraries_of_the_extra_train():
    """Chains of imports may have any length.

    There is one exception: the check of networks that are not shipped needs onnx.
    """
    extra = {"torch", "safetensors", "onnx", "onnxscript"}
    need = {m for m, names in IMPORTS.items() if {name.partition(".")[0] for name in names} & extra}
    need -= {"vslam.loopclosure.siamese.onnx_limits"}
    found: set[str] = set()
    while need - found:
        found |= need
        need = {m for m, targets in ARROWS.items() if targets & (found - {TRAINING_COMMANDS})}
    outside = {m for m in found if not within(m, TRAINING)}
    assert outside == {TRAINING_COMMANDS}


def test_only_its_commands_import_the_training():
    users = {m for m, names in ARROWS.items() if any(within(name, TRAINING) for name in names)}
    assert {m for m in users if not within(m, TRAINING)} == {TRAINING_COMMANDS}


def names_of(path: Path) -> set[str]:
    """Return all names that a module binds outside of functions."""
    names, waiting = set(), list(ast.parse(path.read_text()).body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names.update((one.asname or one.name).partition(".")[0] for one in node.names)
        else:
            names.update(n.id for n in ast.walk(node) if isinstance(n, ast.Name))
            waiting += [n for n in ast.iter_child_nodes(node) if isinstance(n, ast.stmt)]
    return names


# The map has one writer at a time, which may replace these columns. In contrast, frames, features
# and states are values: a function returns a new one.
WRITABLE = {"scalars", "revisits", "parents"}
NOT_TESTED = ("vslam.backend", "vslam.loopclosure", "vslam.report", "vslam_lab")


def fields_of(tree: ast.AST) -> set[str]:
    """Return the names of the attributes of all classes that a module defines."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            inside = list(ast.walk(node))
            names |= {
                n.target.id
                for n in inside
                if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)
            }
            names |= {n.attr for n in inside if isinstance(n, ast.Attribute) and is_own(n)}
    return names


def is_own(node: ast.Attribute) -> bool:
    return isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")


def changed_in(tree: ast.AST) -> Iterator[ast.Attribute]:
    """Yield the attributes that a module assigns, and those whose items it assigns."""
    for node in ast.walk(tree):
        if isinstance(getattr(node, "ctx", None), ast.Store | ast.Del):
            target = node.value if isinstance(node, ast.Subscript) else node
            if isinstance(target, ast.Attribute):
                yield target


def test_no_file_writes_into_the_objects_of_another():
    trees = {name: ast.parse(path.read_text()) for name, path in SOURCES.items()}
    fields = {name: fields_of(tree) for name, tree in trees.items()}
    written = []
    for name, tree in trees.items():
        if any(within(name, other) for other in NOT_TESTED):
            continue
        others = set().union(*(fields[other] for other in IMPORTS[name] & fields.keys()))
        written += [
            f"{name}:{node.lineno} {ast.unparse(node)}"
            for node in changed_in(tree)
            if not is_own(node) and node.attr in others - fields[name] - WRITABLE
        ]
    assert written == []


def test_the_tools_import_what_there_is():
    missing = []
    for path in sorted((ROOT / "tools").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vslam"):
                here = names_of(SOURCES[node.module]) if node.module in SOURCES else set()
                asked = {name.name for name in node.names}
                missing += [
                    f"{path.relative_to(ROOT)}: {node.module}.{name}"
                    for name in asked - here
                    if f"{node.module}.{name}" not in SOURCES
                ]
    assert missing == []


@pytest.mark.slow
def test_the_library_does_not_print():
    printing = set()
    for module, path in SOURCES.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                printing |= {module} if node.func.id == "print" else set()
    assert printing == set()


@pytest.mark.slow
def test_tracking_and_mapping_load_no_heavy_library():
    script = (
        f"import sys, vslam.slam\nsys.stdout.write(' '.join({set(ONLY_IN)} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd="/")
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


@pytest.mark.slow
def test_a_run_loads_what_it_needs(kitti_tree, tmp_path):
    """A third of the start-up time is imports."""
    (tmp_path / "sequences").symlink_to(kitti_tree / "sequences")
    script = (
        "import atexit, sys\n"
        "from vslam.cli.main import main\n"
        f"unneeded = {set(ONLY_IN) - {'deflate', 'typer'} | {'scipy.spatial', 'matplotlib'}}\n"
        "atexit.register(lambda: print(*sorted(unneeded & set(sys.modules))))\n"
        "main()\n"
    )
    words = ["run", "--data", tmp_path, "--no-record", "--no-report", "--quiet"]
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, words)],
        capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr
