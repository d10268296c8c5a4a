"""Who may import whom (DESIGN, section 2), read from the source."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
VOCABULARY = {
    f"vslam.{name}"
    for name in (
        "camera",
        "geometry",
        "features",
        "map",
        "config",
        "errors",
        "eyes",
        "kernels",
        "loops",
        "trajectory",
        "observations",
        "sampling",
    )
}
MIDDLE = ("frontend", "loopclosure", "backend")
APPLICATION = ("slam", "cli", "report", "recorder", "pipeline", "run", "runfolder", "evaluate")
APPLICATION += ("comparison", "console", "loop_evaluation", "bench", "overview")
# Verification of loops uses the frontend's matching and pose.
GRANTED = {
    ("vslam.loopclosure.verification", "vslam.frontend.matching"),
    ("vslam.loopclosure.verification", "vslam.frontend.pose"),
}
ONLY_IN = {
    "torch": "vslam.loopclosure.siamese",
    "torchvision": "vslam.loopclosure.siamese",
    "gtsam": "vslam.backend",
    "rerun": "vslam.recorder",
    "evo": "vslam.evaluate",
    "distributed": "vslam.bench.cluster",
}
CONSOLE = {"vslam.cli", "vslam.console"}


def sources() -> dict[str, Path]:
    """Every module of the package, by its installed name."""
    found = {}
    for folder, package in (("vslam", "vslam"), *((name, f"vslam.{name}") for name in MIDDLE)):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((package, *(p for p in parts if p != "__init__")))] = path
    return found


def within(module: str, package: str) -> bool:
    return module == package or module.startswith(package + ".")


def imports_of(source: str, module: str = "", *, package: bool = False) -> set[str]:
    """Absolute names of all that a source imports, in functions and under TYPE_CHECKING too."""
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


SOURCES = sources()
IMPORTS = {
    module: imports_of(path.read_text(), module, package=path.name == "__init__.py")
    for module, path in SOURCES.items()
}


def test_the_reader_of_imports_sees_every_form():
    source = (
        "import a.b\nfrom c import d\nfrom . import e\nfrom ..f import g\n"
        "def h():\n    import i\nif x:\n    from j.k import l as m\n"
    )
    found = imports_of(source, "p.q.r")
    assert found == {"a.b", "c", "c.d", "p.q", "p.q.e", "p.f", "p.f.g", "i", "j.k", "j.k.l"}


def test_the_modules_are_found():
    assert set(SOURCES) >= VOCABULARY
    assert "vslam.map" in IMPORTS["vslam.frontend.tracking"]
    assert "vslam.frontend.keyframes" in IMPORTS["vslam.slam"]
    assert {"vslam.frontend", "vslam.loopclosure", "vslam.backend"} <= set(SOURCES)


@pytest.mark.parametrize("module", sorted(VOCABULARY))
def test_the_shared_vocabulary_imports_only_itself(module):
    ours = {name for name in IMPORTS[module] if within(name, "vslam")} - {"vslam"}
    foreign = {n for n in ours if not any(within(n, word) for word in VOCABULARY)}
    assert not foreign


@pytest.mark.parametrize("package", MIDDLE)
def test_the_middle_packages_do_not_know_each_other_or_the_application(package):
    others = {f"vslam.{name}" for name in (*MIDDLE, *APPLICATION) if name != package}
    for module, names in IMPORTS.items():
        if not within(module, f"vslam.{package}"):
            continue
        wrong = {
            name
            for name in names
            if any(within(name, other) for other in others)
            and not any(module == who and within(name, what) for who, what in GRANTED)
            and name != "vslam.frontend"
        }
        assert not wrong, module


@pytest.mark.parametrize("library", sorted(ONLY_IN))
def test_heavy_libraries_stay_where_they_belong(library):
    users = {m for m, names in IMPORTS.items() if any(within(name, library) for name in names)}
    assert {m for m in users if not within(m, ONLY_IN[library])} == set()


def test_rerun_and_evo_are_seen_where_they_are_used():
    assert any(within(name, "rerun") for name in IMPORTS["vslam.recorder"])
    assert any(within(name, "evo") for name in IMPORTS["vslam.evaluate"])


def test_the_library_does_not_print():
    printing = set()
    for module, path in SOURCES.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                printing |= {module} if node.func.id == "print" else set()
    assert printing - CONSOLE == set()


def test_tracking_and_mapping_load_no_heavy_library():
    script = (
        f"import sys, vslam.slam\nsys.stdout.write(' '.join({set(ONLY_IN)} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd="/")
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
