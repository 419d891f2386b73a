"""The README's commands have options that exist, and its code uses names that exist."""

import ast
import inspect
import re
import shlex

from commands import run
from places import ROOT

import allanjax as aj

README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
LINES = [line for _, text in BLOCKS for line in text.replace("\\\n", " ").splitlines()]
COMMANDS = sorted({line.removeprefix("$ ") for line in LINES if re.match(r"(\$ )?allanjax \w", line)})


def test_options_of_its_commands_exist():
    assert len(COMMANDS) > 4
    for line in COMMANDS:
        _, command, *words = shlex.split(line, comments=True)
        shown = run(command, "--help")
        assert shown.exit_code == 0, line
        options = set(re.findall(r"--[\w-]+", shown.output))
        assert {word for word in words if word.startswith("--")} <= options, line


def test_names_and_keywords_of_its_code_exist():
    """Of the package and of what its functions take."""
    tree = ast.parse("\n".join(text for language, text in BLOCKS if language == "python"))
    used = [n for n in ast.walk(tree) if isinstance(n, ast.Attribute) and ast.unparse(n.value) == "aj"]
    assert len(used) > 10
    assert all(hasattr(aj, name.attr) for name in used)
    for call in (n for n in ast.walk(tree) if isinstance(n, ast.Call) and n.func in used):
        taken = inspect.signature(getattr(aj, call.func.attr)).parameters
        assert {word.arg for word in call.keywords} <= set(taken), ast.unparse(call)
