"""A .npy file is mapped, and what is wrong with it is said without numpy's advice."""

import pickle

import numpy as np
import pytest

from ultragray.files import map_npy


def npy(path, array):
    np.save(path, array, allow_pickle=True)
    return path.read_bytes()


@pytest.mark.parametrize("array", [np.arange(6, dtype=np.uint8).reshape(1, 2, 3), np.zeros((0, 4)), np.array(2.5)])
def test_an_array_is_mapped(tmp_path, array):
    path = tmp_path / "a.npy"
    npy(path, array)
    mapped = map_npy(path)
    np.testing.assert_array_equal(mapped, array)
    assert mapped.dtype == array.dtype
    assert not mapped.flags.writeable


def test_what_is_wrong_is_named(tmp_path):
    path = tmp_path / "a.npy"
    numbers = npy(path, np.arange(6.0))
    archive = tmp_path / "a.npz"
    np.savez(archive, a=np.arange(6.0))
    for content, reason in [
        (b"", "does not start as a .npy file"),
        (b"garbage", "does not start as a .npy file"),
        (pickle.dumps([1]), "does not start as a .npy file"),
        (archive.read_bytes(), "it is an archive"),
        (numbers[:-3], "it is truncated: 3 bytes are missing"),
        (numbers[:20], "header is damaged or truncated"),
        (numbers[:6], "header is damaged or truncated"),
        (numbers.replace(b"(6,)", b"(-6)"), "header is damaged or truncated"),
        (numbers.replace(b"(6,),", b"(-6,)"), "header is damaged or truncated"),
        (numbers.replace(b"(6,)", b"[{}:"), "header is damaged or truncated"),
        (numbers.replace(b"{", b"("), "header is damaged or truncated"),
        (numbers.replace(b"(6,), }                 ", b"(0, 9223372036854775808)}"), "header is damaged or truncated"),
        (npy(path, np.array([[1], None], dtype=object)), "holds Python objects"),
    ]:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=reason) as caught:
            map_npy(path)
        assert "pickle" not in str(caught.value)
