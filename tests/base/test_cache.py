"""Compiled programs are kept for later processes, and forgotten before the system has no room for more."""

import os
import subprocess
import sys
import warnings

import jax
import numpy as np
import pytest

import allanjax as aj
from allanjax.base import cache
from allanjax.critic.critique import critique


@pytest.mark.parametrize("used", [100, 60_000])
def test_programs_are_forgotten_when_there_are_too_many(monkeypatch, used):
    traced = []

    @jax.jit
    def program(x):
        traced.append(x)
        return 2.0 * x

    program(1.0)
    monkeypatch.setattr(cache, "_mapped", lambda: (used, 65_530))
    cache.release_programs(0.75)
    assert float(program(3.0)) == 6.0
    assert len(traced) == (1 if used == 100 else 2)


@pytest.mark.parametrize("word", ["off", "OFF"])
def test_the_cache_is_where_it_is_said_to_be_or_nowhere(monkeypatch, tmp_path, word):
    set_to = {}
    monkeypatch.setattr(jax.config, "update", set_to.__setitem__)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ALLANJAX_CACHE", word)
    assert aj.enable_compilation_cache() is None
    assert (set_to, list(tmp_path.iterdir())) == ({}, [])
    for said in (str(tmp_path / "by name"), ""):
        monkeypatch.setenv("ALLANJAX_CACHE", said)
        monkeypatch.setattr(cache, "_user_cache", lambda: tmp_path / "user")
        folder = aj.enable_compilation_cache()
        assert folder == (tmp_path / "by name" if said else tmp_path / "user" / "allanjax" / "jax")
        assert folder.is_dir()
        assert set_to["jax_compilation_cache_dir"] == str(folder)
    assert aj.enable_compilation_cache(tmp_path / "given") == tmp_path / "given"


@pytest.fixture
def homeless(monkeypatch, tmp_path):
    """A folder for temporary files of a user who cannot write to the home, and what JAX was told."""
    told = {}
    (tmp_path / "file").write_text("")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("ALLANJAX_CACHE", "")
    monkeypatch.setattr(jax.config, "update", told.__setitem__)
    monkeypatch.setattr(cache, "_user_cache", lambda: tmp_path / "file")
    monkeypatch.setattr(cache.tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield tmp_path / "temporary", told


def test_a_home_that_cannot_be_written_to_is_nobodys_mistake(homeless, monkeypatch):
    temporary, told = homeless
    folder = aj.enable_compilation_cache()
    assert folder.parent == temporary
    assert told["jax_compilation_cache_dir"] == str(folder)
    assert aj.enable_compilation_cache() == folder
    with pytest.raises(UserWarning, match="ALLANJAX_CACHE"):
        aj.enable_compilation_cache(temporary.parent / "file" / "cache")

    def nowhere():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(cache, "_user_cache", nowhere)
    assert aj.enable_compilation_cache() == folder


@pytest.mark.skipif(os.name != "posix", reason="elsewhere each user has temporary files of their own")
@pytest.mark.parametrize("what", ["writable by others", "somebody else's", "a link", "a file"])
def test_programs_that_another_may_have_written_are_not_used(homeless, monkeypatch, what):
    temporary, told = homeless
    folder = temporary / f"allanjax-{os.getuid()}"
    if what == "writable by others":
        folder.mkdir()
        folder.chmod(0o777)
    elif what == "somebody else's":
        folder.mkdir()
        uid = os.getuid() + 1
        folder.rename(temporary / f"allanjax-{uid}")
        monkeypatch.setattr(os, "getuid", lambda: uid)
    elif what == "a link":
        (temporary / "elsewhere").mkdir()
        folder.symlink_to(temporary / "elsewhere")
    else:
        folder.write_text("")
    assert aj.enable_compilation_cache() is None
    assert told == {}


PROGRAM = """
import sys
from collections import Counter
from jax import monitoring
seen = Counter()
monitoring.register_event_listener(lambda event, **_: seen.update([event.rpartition("/")[2]]))
from allanjax.cli.app import main
sys.argv[0] = "allanjax"
try:
    main()
finally:
    print(seen["compile_requests_use_cache"], seen["cache_hits"])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="where home and temporary files are")
def test_commands_find_all_that_an_earlier_one_compiled_also_without_a_home(tmp_path):
    (tmp_path / "home").write_text("")
    (tmp_path / "temporary").mkdir()
    others = {"ALLANJAX_CACHE", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"}
    environment = {key: value for key, value in os.environ.items() if key not in others}
    environment |= {"HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path / "temporary")}
    arguments = ["simulate", "--terms", "N=1 deg/√h + K=1 deg/h/√h", "--duration", "60", "--out", "a.csv"]
    counts = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, *arguments],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert (done.returncode, done.stderr) == (0, "")
        counts.append(tuple(map(int, done.stdout.split()[-2:])))
    (asked, hits), again = counts
    assert asked > hits
    assert again == (asked, asked)


@pytest.mark.skipif(cache._mapped()[0] == 0, reason="only Linux has such a limit")
def test_what_is_mapped_is_counted():
    used, limit = cache._mapped()
    assert 10 < used < limit


def test_a_fit_and_a_critique_go_on_with_their_programs_forgotten(monkeypatch):
    """As in a process that has gone through recordings of many lengths."""
    samples = np.random.default_rng(0).standard_normal(5000)
    recording = aj.Recording.from_array(samples, 50.0, gyro_unit="rad/s", names=["gyro_x"])
    before = aj.fit(recording)["gyro_x"]["angle_random_walk"].value
    monkeypatch.setattr(cache, "_mapped", lambda: (60_000, 65_530))
    assert aj.fit(recording)["gyro_x"]["angle_random_walk"].value == before
    assert critique(recording).findings == ()
