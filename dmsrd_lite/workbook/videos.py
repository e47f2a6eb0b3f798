"""Rollouts as small videos inside a notebook: drawn from the state, so that no GL library is needed."""

import base64
import io
import os
import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np

from dmsrd_lite.domains import Domain
from dmsrd_lite.workbook.figures import drawing_of


def film(
    domain: Domain, observations: np.ndarray, columns: int = 3, every: int = 2, progress: Callable = iter
) -> np.ndarray:
    """Frames (n_frames, height, width, 3) of trajectories (n, T, obs_dim) side by side."""
    draw, n, frames = drawing_of(domain).frame, len(observations), []
    rows = -(-n // columns)
    for states in progress(np.moveaxis(observations, 1, 0)[::every]):
        tiles = [draw(s) for s in states]
        tiles += [np.full_like(tiles[0], 255)] * (rows * columns - n)
        frames.append(np.vstack([np.hstack(tiles[r * columns : (r + 1) * columns]) for r in range(rows)]))
    return np.array(frames)


def picture(frame: np.ndarray) -> bytes:
    """A frame (height, width, 3) as a PNG file."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(frame).save(file, "png")
    return file.getvalue()


def show_video(frames: np.ndarray, frames_per_second: float) -> Any:
    """An MP4 inside the notebook, as wide as fits; its first frame stands before it is played."""
    import imageio_ffmpeg
    from IPython.display import HTML

    # the browser's controls cover the lowest 50 pixels: white ones
    frames = np.pad(frames, ((0, 0), (0, 52), (0, 0), (0, 0)), constant_values=255)
    height, width = frames.shape[1] // 2 * 2, frames.shape[2] // 2 * 2
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "video.mp4")
        writer = imageio_ffmpeg.write_frames(
            path, (width, height), fps=frames_per_second, macro_block_size=2, quality=6
        )
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame[:height, :width]))
        writer.close()
        with open(path, "rb") as file:
            video = base64.b64encode(file.read()).decode()
    poster = base64.b64encode(picture(frames[0])).decode()
    return HTML(
        f'<video controls loop muted width="{width}" style="max-width:100%" '
        f'poster="data:image/png;base64,{poster}" src="data:video/mp4;base64,{video}"></video>'
    )
