"""A cluster whose workers are threads of this process, and fleets with it."""

import json

import numpy as np
import pytest
from fleets import Fleet

import allanjax as aj


@pytest.fixture(scope="session")
def cluster():
    """Address of a cluster of one worker in this process."""
    from distributed import LocalCluster

    how = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with pytest.MonkeyPatch.context() as patch:
        # A worker sets these for its process, which it has for itself elsewhere.
        patch.setenv("NPROC", "1")
        patch.setenv("ALLANJAX_CACHE", "off")
        with LocalCluster(**how) as cluster:
            yield cluster.scheduler_address


@pytest.fixture(scope="session")
def logs(tmp_path_factory):
    """Recordings of five units, of a gyro and an accelerometer; one gyro is bad; and a file that is none."""
    folder = tmp_path_factory.mktemp("logs")
    rng = np.random.default_rng(1)
    about = {"gyro_unit": "deg/s", "accel_unit": "g", "names": ["gyro_x", "accel_z"]}
    for k, factor in enumerate(np.exp(0.05 * rng.standard_normal(5))):
        x = factor * rng.standard_normal((2048, 2)) * [1.0 if k == 3 else 0.1, 1e-3] + [0.2, 1.0]
        x[:, 1] += 2e-5 * np.cumsum(rng.standard_normal(2048))
        aj.write(aj.Recording.from_array(x, 100.0, **about), folder / f"unit_{k}.parquet")
    (folder / "corrupt.parquet").write_bytes(b"PAR1 but no more")
    return folder


@pytest.fixture(scope="session")
def characterized(logs, cluster, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return out, aj.characterize_fleet(logs / "*.parquet", out, "N + K", plain=True, scheduler=cluster)


@pytest.fixture
def fleet(characterized, tmp_path, monkeypatch):
    """A fleet of fits that are made up, with no options but the default; nothing is drawn."""
    key = json.loads((characterized[0] / "recordings" / "unit_0.json").read_text(encoding="utf-8"))["key"]
    key["options"] |= {"model": None, "plain": False}
    monkeypatch.setattr(aj.FleetResult, "plot", lambda *arguments: None)
    return Fleet(tmp_path, key)
