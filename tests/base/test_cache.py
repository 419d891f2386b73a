"""Compiled programs are forgotten before the operating system has no room for more."""

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
