"""Compiled programs are kept for later processes where the user says, or where nobody else can write."""

import os
import subprocess
import sys
import tempfile
import warnings

import jax
import pytest

import allanjax as aj

posix = pytest.mark.skipif(os.name != "posix", reason="elsewhere each user has temporary files of their own")


@pytest.fixture
def told(monkeypatch, tmp_path):
    """What JAX was told, in a folder with a home that cannot be written to: it is a file."""
    found = {}
    monkeypatch.setattr(jax.config, "update", found.__setitem__)
    monkeypatch.chdir(tmp_path)
    for name in ("home", "temporary"):
        (tmp_path / name).mkdir()
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ALLANJAX_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is a convention of Linux")
def test_it_is_nowhere_or_where_it_is_said_to_be_or_the_users(told, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("ALLANJAX_CACHE", "OFF")
    assert aj.enable_compilation_cache() is None
    assert (told, list((tmp_path / "home").iterdir())) == ({}, [])
    for said, expected in ((str(tmp_path / "by name"), "by name"), ("", "home/allanjax/jax")):
        monkeypatch.setenv("ALLANJAX_CACHE", said)
        folder = aj.enable_compilation_cache()
        assert (folder, folder.is_dir()) == (tmp_path / expected, True)
        assert told["jax_compilation_cache_dir"] == str(folder)
        assert told["jax_persistent_cache_min_compile_time_secs"] == 0.0
    assert aj.enable_compilation_cache(tmp_path / "given") == tmp_path / "given"


@posix
def test_a_home_that_cannot_be_written_to_is_nobodys_mistake(told, monkeypatch, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        folder = aj.enable_compilation_cache()
        assert folder.parent == tmp_path / "temporary"
        assert told["jax_compilation_cache_dir"] == str(folder)
        assert aj.enable_compilation_cache() == folder
    # A folder that was asked for is another matter.
    monkeypatch.setenv("ALLANJAX_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.warns(UserWarning, match="ALLANJAX_CACHE"):
        assert aj.enable_compilation_cache() is None


@posix
@pytest.mark.parametrize("what", ["writable by others", "somebody else's", "a link", "a file"])
def test_programs_that_another_may_have_written_are_not_used(told, monkeypatch, tmp_path, what):
    uid = os.getuid() + (what == "somebody else's")
    monkeypatch.setattr(os, "getuid", lambda: uid)
    folder = tmp_path / "temporary" / f"allanjax-{uid}"
    if what == "a link":
        folder.symlink_to(tmp_path / "home")
    elif what == "a file":
        folder.write_text("")
    else:
        folder.mkdir()
        folder.chmod(0o777 if what == "writable by others" else 0o700)
    assert aj.enable_compilation_cache() is None
    assert told == {}


PROGRAM = """
import sys
from collections import Counter
from jax import monitoring
seen = Counter()
monitoring.register_event_listener(lambda event, **_: seen.update([event.rpartition("/")[2]]))
from allanjax.cli.app import app
app("simulate --terms N=1deg/√h+K=1deg/h/√h --duration 60 --out a.csv".split(), standalone_mode=False)
print(seen["compile_requests_use_cache"], seen["cache_hits"])
"""


@pytest.mark.study
@pytest.mark.skipif(sys.platform != "linux", reason="where home and temporary files are")
def test_commands_find_all_that_an_earlier_one_compiled_also_without_a_home(told, tmp_path):
    environment = os.environ | {"HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path / "temporary")}
    for name in ("ALLANJAX_CACHE", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    counts = []
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, stdout=-1, check=True)
        counts.append(tuple(map(int, done.stdout.split()[-2:])))
    (asked, hits), again = counts
    assert asked > hits
    assert again == (asked, asked)
