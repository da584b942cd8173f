"""Frames on their way from where they are rendered to the encoder."""

import numpy as np
import pytest
import torch

from ultragray.rendering.backends import cuda
from ultragray.rendering.pixels import in_type, to_uint8
from ultragray.rendering.settings import Encoding
from ultragray_workers.pool.pixels import CHUNK_POSES, render_to_host, round_to_uint8

UINT8, FLOAT32 = np.dtype("u1"), np.dtype("<f4")
POSES = 2 * CHUNK_POSES + 3
WANTED = {"bmode": {UINT8, FLOAT32}, "echo": {UINT8}, "labels": {UINT8, FLOAT32}}

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")


@pytest.fixture
def poses():
    """[C, 4, 4], each with its own number in a corner."""
    poses = np.tile(np.eye(4), (POSES, 1, 1))
    poses[:, 0, 3] = np.arange(POSES)
    return poses


def brightness(poses):  # -> [C]
    return (poses[:, 0, 3] + 0.5) / POSES


def render_on(device, sizes):
    """Frames of 5x7 pixels, each as bright as its pose says; notes how many were asked for at once."""

    def render(poses):
        sizes.append(len(poses))
        level = cuda.upload(torch.from_numpy(brightness(poses)).float(), torch.device(device))
        bmode = level[:, None, None].expand(-1, 5, 7).contiguous()
        return {"bmode": bmode, "echo": 1.0 - bmode, "labels": (bmode * 200.0).to(torch.uint8)}

    return render


def expect_all(frames, poses):
    """Every output in every pixel type, in pieces that do not end where chunks do."""
    level = brightness(poses).astype(np.float32)[:, None, None] * np.ones((1, 5, 7), np.float32)
    labels = (level * np.float32(200)).astype(np.uint8)
    for name, expected in (("bmode", level), ("echo", np.float32(1) - level), ("labels", labels)):
        for pixel_type in WANTED[name]:
            for first, stop in ((0, 1), (1, CHUNK_POSES + 1), (CHUNK_POSES + 1, POSES), (0, POSES)):
                pixels = frames.take(name, pixel_type, first, stop)
                if name == "labels":
                    encoded = Encoding(pixel_type.name)
                    np.testing.assert_array_equal(in_type(pixels, encoded.pixel_type), expected[first:stop])
                elif pixel_type == UINT8:
                    np.testing.assert_array_equal(to_uint8(pixels), to_uint8(expected[first:stop]))
                else:
                    np.testing.assert_array_equal(pixels, expected[first:stop])


def test_on_the_cpu_a_batch_is_rendered_at_once_and_not_copied(poses):
    sizes = []
    frames = render_to_host(render_on("cpu", sizes), poses, WANTED, torch.device("cpu"))
    assert sizes == [POSES]
    expect_all(frames, poses)
    assert np.shares_memory(frames.take("bmode", UINT8, 0, 2), frames.take("bmode", FLOAT32, 1, 3))
    assert frames.waited_ms == 0.0


def test_rounding_equals_the_encoders():
    values = [*(np.arange(511) / 510), 1.0, 1.0 + 1e-6, 3.0, *np.random.default_rng(0).random(1000)]
    frames = np.array(values, np.float32).reshape(1, 2, -1)
    before = frames.copy()
    np.testing.assert_array_equal(round_to_uint8(torch.from_numpy(frames)).numpy(), to_uint8(frames))
    np.testing.assert_array_equal(frames, before)


@pytest.mark.gpu
@needs_gpu
def test_from_a_gpu_frames_come_in_chunks_rounded_there(poses):
    device = torch.device("cuda", 0)
    for _ in range(3):  # the second time into pinned memory of the first
        sizes = []
        frames = render_to_host(render_on(device, sizes), poses, WANTED, device)
        assert sizes == [CHUNK_POSES, CHUNK_POSES, 3]
        expect_all(frames, poses)
        assert frames.take("echo", UINT8, 0, 1).dtype == np.uint8


@pytest.mark.gpu
@needs_gpu
def test_a_chunk_that_takes_long_is_waited_for(poses):
    device = torch.device("cuda", 0)
    sizes = []
    quick = render_on(device, sizes)

    def render(some):
        torch.cuda._sleep(50_000_000)
        return quick(some)

    frames = render_to_host(render, poses, WANTED, device)
    expect_all(frames, poses)
    assert frames.waited_ms > 1.0
