"""Damaged files of every format are read right, or refused by their name with a reason."""

import struct
import zipfile
from contextlib import suppress

import numpy as np
import pytest
from mutated_files import WRITERS, damaged, outcome, sample_files
from scipy.io import savemat

from allanjax.base.errors import RecordingError
from allanjax.record.io import read, read_chunks

#: Damaged files of each format; `benchmarks/studies/fuzz_files.py` reads a hundred thousand.
COUNT = 25
UNITS = {"gyro_unit": "deg/s", "accel_unit": "m/s^2", "rate": 100.0}


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return sample_files(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def noise():
    return np.random.default_rng(2).normal(size=(50, 6))


def refused(path, *said, reader=read, **options):
    with pytest.raises(RecordingError) as caught:
        list(reader(path, **{**UNITS, **options}))
    for text in (str(path), *said):
        assert text in str(caught.value)


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_at_random(samples, name):
    sample = samples[name]
    content = sample.part.read_bytes()
    whole = read(sample.path, **sample.options)
    assert outcome(sample, whole) == "as before"
    try:
        for seed in range(COUNT):
            sample.part.write_bytes(damaged(content, np.random.default_rng([seed, 1])))
            told = outcome(sample, whole)
            assert told in ("as before", "otherwise", "refused"), f"seed {seed}: {told}"
    finally:
        sample.part.write_bytes(content)


def test_a_log_in_which_pyulog_would_go_back_for_ever(samples, tmp_path):
    """The last of its definitions claims more bytes than there are."""
    path = tmp_path / "log.ulg"
    path.write_bytes(damaged(samples["ULog"].part.read_bytes(), np.random.default_rng(5_001_447)))
    with pytest.raises(RecordingError, match="reading it does not end"):
        read(path)


@pytest.mark.parametrize("value", [1e307, -1.7e308, 1e101])
@pytest.mark.parametrize("reader", [read, read_chunks])
def test_numbers_that_overflow_when_they_are_scaled_or_squared(tmp_path, noise, value, reader):
    noise[7, 4] = value
    path = tmp_path / "imu.npy"
    np.save(path, noise)
    options = {"accel_unit": "m/s", "gyro_unit": "rad"}
    refused(path, "'accel_y'", "row 7", f"{value:.3g}"[:4], "within ±1e+100", reader=reader, **options)


def test_an_array_that_claims_to_be_large(tmp_path, noise):
    """No memory is taken for it: its size is compared with the file's before."""
    path = tmp_path / "imu.npz"
    np.savez_compressed(path, gyro=noise[:, :3])
    with zipfile.ZipFile(path) as archive:
        content = archive.read("gyro.npy")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "gyro.npy", content.replace(b"(50, 3), }", b"(50000000000, 3), }").replace(b" " * 9, b"", 1)
        )
    refused(path, "'gyro.npy' has the shape (50000000000, 3) by its header")
    # What is compressed as far as it can be is no such claim.
    np.savez_compressed(path, gyro=np.zeros((10**6, 3)), accel=np.tile(noise[:, 3:], (20_000, 1)))
    assert read(path, **UNITS).n == 10**6


def test_a_header_of_npy_that_is_no_literal(tmp_path, noise):
    path = tmp_path / "imu.npy"
    np.save(path, noise)
    path.write_bytes(path.read_bytes().replace(b"'descr'", b"'desc((", 1))
    refused(path, "can not be read as .npy")


def test_a_damaged_member_of_npz(tmp_path, noise):
    path = tmp_path / "imu.npz"
    np.savez(path, gyro=noise[:, :3])
    content = bytearray(path.read_bytes())
    content[300] ^= 1
    path.write_bytes(content)
    refused(path, "can not be read as .npz", "Bad CRC-32")


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (176, 8, "an element of the kind 8"),
        (144, 6 | 0x800, "an array without its numbers"),
        (132, 10**9, "an element of 1000000000 bytes"),
        (128, 6, "an element of the kind 6 where an array is expected"),
    ],
)
def test_elements_of_matlab_that_would_end_the_program(tmp_path, noise, place, value, said):
    path = tmp_path / "imu.mat"
    savemat(path, {"gyro": noise[:, :3]})
    content = bytearray(path.read_bytes())
    content[place : place + 4] = struct.pack("<I", value)
    path.write_bytes(content)
    refused(path, "can not be read as a MATLAB file", said)


def test_arrays_of_all_classes_of_matlab(tmp_path, noise):
    more = {
        "text": "imu",
        "cells": np.array(["a", noise[:3]], dtype=object),
        "struct": {"serial": 7, "words": "a", "deeper": {"complex": np.array([1j, 2.0])}},
        "empty": np.zeros((0, 0)),
        "whole": np.arange(3, dtype=np.int16),
    }
    for how in ({}, {"do_compression": True}):
        path = tmp_path / "imu.mat"
        savemat(path, {"gyro": noise[:, :3], "struct": more["struct"], "text": "imu"}, **how)
        assert read(path, **UNITS).n == 50
        savemat(path, more, **how)
        refused(path, ".mat")


def test_groups_of_hdf5_that_are_damaged(tmp_path, noise):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "imu.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("gyro", data=noise[:, :3])
    content = path.read_bytes()
    for place in range(96, len(content) - 8, 64):
        path.write_bytes(content[:place] + b"\xff" * 8 + content[place + 8 :])
        with suppress(RecordingError):
            read(path, **UNITS)
    with h5py.File(path, "w") as file:
        file.create_dataset("gyro", shape=(10**12, 3), dtype="f8", chunks=(1000, 3))
    refused(path, "it claims to hold 24000000000000 bytes")
