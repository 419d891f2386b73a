"""How many bugs of one line, planted by a program all over the package, do the tests catch?

Bugs are drawn from the syntax trees of all rooms of allanjax, a room's share by its lines and one at least: a
comparison turned or moved to or off its bound, arithmetic swapped, a constant changed by 10 % or twofold,
`and` for `or`, `min` for `max`, a root left out, an index off by one, a condition negated, None returned, a
keyword left out. Not in docstrings, annotations, messages, words for people, nor in lines outside of
functions. Each is planted in a copy of the repository, where the tests of its room are run first, with the
golden run where it looks at the room, and all others of the default suite where these pass. A survivor may be
no bug at all: these are noted by hand.
"""

from __future__ import annotations

import ast
import copy
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.common.study import ROOT, commit_of, table

QUICK: dict[str, Any] = {"count": 0}
SWAPPED = {"Add": "Sub", "Sub": "Add", "Mult": "Div", "Div": "Mult", "Pow": "Mult", "FloorDiv": "Mult"}
SWAPPED |= {"BitAnd": "BitOr", "BitOr": "BitAnd"}
COMPARED = {"Lt": "LtE Gt", "LtE": "Lt GtE", "Gt": "GtE Lt", "GtE": "Gt LtE", "Eq": "NotEq", "NotEq": "Eq"}
COMPARED |= {"Is": "IsNot", "IsNot": "Is", "In": "NotIn", "NotIn": "In"}
RENAMED = {"min": "max", "minimum": "maximum", "any": "all", "argmin": "argmax", "nanmin": "nanmax"}
RENAMED |= {"floor": "ceil", "sin": "cos", "log": "log1p"}
RENAMED |= {new: old for old, new in RENAMED.items()} | {"mean": "sum", "std": "var"}
#: Functions whose body is words for people, and calls whose arguments are.
WORDS = {"__repr__", "__str__", "describe", "summary", "story", "lines", "title", "explain", "print"}


#: Rooms whose numbers are in the golden run.
GOLDEN = {"noise", "allan", "spectrum", "estimate", "posterior", "critic"}
#: A bug: its room, place, kind, the line before and after, and the whole file with it.
Mutant = dict[str, Any]


def run(
    *,
    seed: int = 1,
    count: int = 40,
    jobs: int = 1,
    limit: float = 3600.0,
    state: str = tempfile.gettempdir(),
) -> Iterator[str]:
    """Limit: seconds after which tests hang, which is seen; state: folder of what is done, to go on from."""
    log = Path(state) / f"mutants-{commit_of(ROOT).split()[0]}-{seed}-{count}.jsonl"
    rows = map(json.loads, log.read_text(encoding="utf-8").splitlines() if log.exists() else [])
    done = {(row["place"], row["after"]): row for row in rows}

    def judged(mutant: Mutant) -> dict[str, Any]:
        if found := done.get((mutant["place"], mutant["after"])):
            return found
        row = {key: value for key, value in mutant.items() if key != "text"}
        row |= caught(mutant, Path(state), limit)
        with log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        print(row["place"], row["by"], f"{row['s']} s", file=sys.stderr, flush=True)
        return row

    with ThreadPoolExecutor(jobs) as pool:
        rows = list(pool.map(judged, drawn(seed, count)))
    seen, own = (sum(bool(row["stage"]) for row in rows), sum(row["stage"] == "room" for row in rows))
    yield f"{seen} of {len(rows)} caught, {own} by the tests of its own room or the golden run. Seed {seed}."
    head = ["place", "kind", "before", "after", "by", "s"]
    yield table(head, [[str(row[key]).replace("|", "\\|") for key in head] for row in rows])


# --- Bugs --------------------------------------------------------------------------------------------------


def drawn(seed: int, count: int) -> list[Mutant]:
    """About so many bugs, each room's share by its lines, one at least; no two on one line."""
    rng, files, lines = random.Random(seed), defaultdict(list), Counter()
    for path in sorted((ROOT / "allanjax").rglob("*.py")):
        room = path.relative_to(ROOT / "allanjax").parts[0]
        if not room.endswith(".py") and path.name != "__init__.py":
            files[room].append(path)
            lines[room] += path.read_text(encoding="utf-8").count("\n")
    if not count:
        return []
    counts = {room: max(1, round(count * lines[room] / lines.total())) for room in files}
    found = []
    for room, paths in files.items():
        weights = [path.stat().st_size for path in paths]
        own: dict[str, Mutant] = {}
        while len(own) < counts[room]:
            (path,) = rng.choices(paths, weights)
            if mutant := mutated(rng, room, path):
                own.setdefault(mutant["place"], mutant)
        found += own.values()
    return found


def mutated(rng: random.Random, room: str, path: Path) -> Mutant | None:
    """A bug in a file: first its kind, so that constants do not crowd out the rest, then its place."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    kinds = defaultdict(list)
    for node in places(tree):
        for kind, other in variants(node):
            kinds[kind].append((node, other))
    if not kinds:
        return None
    kind = rng.choice(sorted(kinds))
    node, other = rng.choice(kinds[kind])
    if node.end_lineno != node.lineno:
        return None
    lines, new = text.splitlines(), ast.unparse(other)
    line = lines[node.lineno - 1]
    if not isinstance(other, (ast.Constant, ast.Name, ast.Call, ast.Return)):
        new = f"({new})"
    # Columns count bytes.
    raw = line.encode()
    after = (raw[: node.col_offset] + new.encode() + raw[node.end_col_offset :]).decode()
    changed = "\n".join([*lines[: node.lineno - 1], after, *lines[node.lineno :]]) + "\n"
    try:
        if ast.dump(ast.parse(changed)) == ast.dump(tree):
            return None
    except SyntaxError:
        return None
    place = f"{path.relative_to(ROOT)}:{node.lineno}"
    told = {"before": f"`{line.strip()}`", "after": f"`{after.strip()}`"}
    return {"room": room, "place": place, "kind": kind, "text": changed, **told}


def places(tree: ast.Module) -> Iterator[Any]:
    """Expressions and statements that are executed in functions, but for what is said to people."""

    def walk(node: ast.AST, inside: bool) -> Iterator[Any]:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            wrapped = " ".join(ast.unparse(decorator) for decorator in node.decorator_list)
            if node.name not in WORDS and "overload" not in wrapped and "presented" not in wrapped:
                for part in node.body:
                    yield from walk(part, True)
            return
        if isinstance(node, (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom)):
            return
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            return
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            return
        if isinstance(node, (ast.If, ast.While)):
            node.test.decides = True  # type: ignore[attr-defined]
        if inside and hasattr(node, "lineno"):
            yield node
        for field, value in ast.iter_fields(node):
            if field in ("annotation", "returns", "decorator_list", "type_params"):
                continue
            for part in value if isinstance(value, list) else [value]:
                if isinstance(part, ast.AST):
                    yield from walk(part, inside)

    yield from walk(tree, False)


def variants(node: Any) -> Iterator[tuple[str, ast.AST]]:
    """Kinds of bugs and what stands there then."""

    def like(**fields: Any) -> Any:
        other = copy.deepcopy(node)
        for name, value in fields.items():
            setattr(other, name, value)
        return other

    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        others = COMPARED[type(node.ops[0]).__name__].split()
        yield from (("comparison", like(ops=[getattr(ast, other)()])) for other in others)
    if isinstance(node, ast.BinOp) and (swapped := SWAPPED.get(type(node.op).__name__)):
        texts = (isinstance(x, (ast.JoinedStr, ast.List)) or _word(x) for x in (node.left, node.right))
        if not any(texts):
            yield "arithmetic", like(op=getattr(ast, swapped)())
    if isinstance(node, ast.Constant) and type(node.value) is float and node.value:
        yield from (("constant", like(value=node.value * factor)) for factor in (0.9, 1.1, 0.5, 2.0))
    if isinstance(node, ast.Constant) and type(node.value) is int:
        steps = [step for step in (-1, 1) if node.value + step >= 0]
        yield from (("whole number", like(value=node.value + step)) for step in steps)
    if isinstance(node, ast.BoolOp):
        yield "and, or", like(op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub)):
        yield "sign, not", node.operand
    if isinstance(node, ast.IfExp):
        yield "condition", like(test=ast.UnaryOp(ast.Not(), node.test))
    if isinstance(node, ast.expr) and getattr(node, "decides", False):
        yield "condition", ast.UnaryOp(ast.Not(), copy.deepcopy(node))
    if isinstance(node, ast.Return) and node.value is not None:
        yield "returned", like(value=ast.Constant(None))
    if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Slice) and node.slice.lower is not None:
        moved = copy.deepcopy(node.slice)
        moved.lower = ast.BinOp(node.slice.lower, ast.Add(), ast.Constant(1))
        yield "index", like(slice=moved)
    if isinstance(node, ast.Call):
        yield from _calls(node, like)


def _calls(node: ast.Call, like: Any) -> Iterator[tuple[str, ast.AST]]:
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name == "sqrt" and len(node.args) == 1:
        yield "root", node.args[0]
    if name in RENAMED:
        func = copy.deepcopy(node.func)
        setattr(func, "attr" if isinstance(func, ast.Attribute) else "id", RENAMED[name])
        yield "function", like(func=func)
    for k, keyword in enumerate(node.keywords):
        if keyword.arg and not _word(keyword.value) and name not in WORDS:
            yield "keyword", like(keywords=[*node.keywords[:k], *node.keywords[k + 1 :]])


def _word(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


# --- Tests -------------------------------------------------------------------------------------------------


def caught(mutant: Mutant, state: Path, limit: float) -> dict[str, Any]:
    """By which test, at which stage, after how many seconds; not by one that fails without the bug, too."""
    begun, cache, failing = time.perf_counter(), state / "mutants-programs", []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "copy"
        ignored = shutil.ignore_patterns(".git", "__pycache__", ".*_cache", "*.egg-info", "shared")
        shutil.copytree(ROOT, root, ignore=ignored)
        (root / mutant["place"].split(":")[0]).write_text(mutant["text"], encoding="utf-8")
        own = [f"tests/{mutant['room']}", *(["tests/golden"] if mutant["room"] in GOLDEN else [])]
        for stage, paths in {"room": own, "others": ["tests", *(f"--ignore={path}" for path in own)]}.items():
            while by := failure(root, [*paths, *failing], cache, limit):
                if not by.startswith("tests/") or not failure(ROOT, [by], cache, limit):
                    return {"by": by, "stage": stage, "s": round(time.perf_counter() - begun)}
                failing.append(f"--deselect={by}" if "::" in by else f"--ignore={by}")
    return {"by": "survived", "stage": "", "s": round(time.perf_counter() - begun)}


def failure(root: Path, paths: list[str], cache: Path, limit: float) -> str:
    """The first test that fails, or what else ends the run; empty where all pass."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache), "PYTHONDONTWRITEBYTECODE": "1"}
    environment.setdefault("ALLANJAX_DATA", str(ROOT.parent / "shared" / "data"))
    how = ["-x", "-n0", "-p", "no:cacheprovider", "-m", "not study and not notebook", "--tb=no"]
    command = [sys.executable, "-m", "pytest", *paths, *how]
    try:
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return "hangs"
    told = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    if told:
        return told[0].split(" ", 1)[1].split(" - ")[0]
    # 1 without a failing test is the budget of compiled programs, 5 that no test is there.
    return "" if done.returncode in (0, 1, 5) else f"exit code {done.returncode}"
