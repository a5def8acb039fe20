"""A recording as a GIF or an MP4, at the speed at which the game is played."""

from __future__ import annotations

import io
from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from liir_common.battle.env import BattleEnv
from liir_common.battle.render import Image, draw_rgb
from liir_common.battle.snapshots import UnitRecord
from liir_common.errors import ConfigError
from liir_common.replay.record import Frame, Recording

_STEPS_PER_SECOND: float = BattleEnv.metadata["render_fps"]
_PICTURES_PER_STEP = 8
_SCALE = 24
"""Pixels per cell; even, since H.264 wants even sizes"""
_SHOT = 0.5
"""Share of a step in which its shots are seen; its blasts are in the rest"""
_LAST_SECONDS = 1.5
"""How long the end is shown"""


def write_gif(recording: Recording) -> bytes:
    """An endless GIF with four frames a step.

    Raises:
        ConfigError: Pillow is not installed.
    """
    try:
        from PIL import Image as pillow
    except ImportError:
        raise ConfigError('a GIF wants Pillow: pip install "liir-service[animation]"') from None
    per_step = _PICTURES_PER_STEP // 2
    frames = [pillow.fromarray(image) for image in draw_frames(recording, per_step)]
    milliseconds = [10 * round(100 / (_STEPS_PER_SECOND * per_step))] * len(frames)  # a GIF counts in 10 ms
    milliseconds[-1] = round(1000 * _LAST_SECONDS)
    file = io.BytesIO()
    frames[0].save(file, "GIF", save_all=True, append_images=frames[1:], duration=milliseconds, loop=0)
    return file.getvalue()


def write_mp4(recording: Recording) -> bytes:
    """An H.264 video with eight frames a step.

    Raises:
        ConfigError: PyAV is not installed.
    """
    try:
        import av
    except ImportError:
        raise ConfigError('an MP4 wants PyAV: pip install "liir-service[animation]"') from None
    rate = Fraction(_STEPS_PER_SECOND * _PICTURES_PER_STEP).limit_denominator(10)
    images = list(draw_frames(recording, _PICTURES_PER_STEP))
    images += images[-1:] * round(_LAST_SECONDS * rate)
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate, options={"crf": "20"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"  # the one that every player knows
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image))))
        container.mux(stream.encode())
    return file.getvalue()


def draw_frames(recording: Recording, per_step: int) -> Iterator[Image]:
    """Images [H, W, 3] of the ground, `per_step` of each step and one of the end.

    Units glide between the places where they were recorded.
    """
    pathing = recording.pathing
    columns, rows = (np.flatnonzero(pathing.any(axis)) for axis in (1, 0))
    ground = (
        slice((len(pathing.T) - 1 - rows[-1]) * _SCALE, (len(pathing.T) - rows[0]) * _SCALE),
        slice(columns[0] * _SCALE, (columns[-1] + 1) * _SCALE),
    )
    steps = zip(recording.frames, recording.frames[1:], recording.shots, recording.blasts, strict=False)
    for before, after, shots, blasts in steps:
        for share in np.arange(per_step) / per_step:
            units = _between(before, after, share)
            if share < _SHOT:
                image = draw_rgb(units, pathing, shots, scale=_SCALE)
            else:
                image = draw_rgb(units, pathing, blasts=blasts, scale=_SCALE)
            yield image[ground]
    yield draw_rgb(recording.frames[-1], pathing, scale=_SCALE)[ground]


def _between(before: Frame, after: Frame, share: float) -> list[UnitRecord]:
    return [_mix(old, new, share) for old, new in zip(before, after, strict=True)]


def _mix(old: UnitRecord, new: UnitRecord, share: float) -> UnitRecord:
    unit = old.copy()
    for key in ("x", "y", "health", "shield"):
        unit[key] += share * (new[key] - old[key])
    return unit
