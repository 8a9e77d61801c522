"""Image files as tensors: the colours of a photograph, and masks of the object in it."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.errors import error_context

FORMATS = ("PNG", "JPEG")
EIGHT_BIT = ("L", "LA", "RGB", "RGBA")
MAX_GREY_DIFFERENCE = 0.1  # difference between the channels of a grey, at most
SIXTEEN_BIT = ("I;16", "I;16B", "I")  # Pillow's names for 16 bits of grey


def read_picture(path: Path) -> tuple[Float[Tensor, "height width 3"], Bool[Tensor, "height width"] | None]:
    """Colours from 0 to 1 as they are stored, and where alpha is more than half (None where there is no alpha).

    The orientation in EXIF is left alone, as cameras are given for the pixels as they are stored. Of 16-bit colour
    the upper eight bits are read. Raises `ValueError` for a file that is no PNG or JPEG, or is cut off.
    """
    levels = _levels(path)
    channels = levels.shape[-1]
    colour = levels[..., :3] if channels >= 3 else levels[..., :1].expand(-1, -1, 3)
    if channels not in (2, 4):
        return colour.contiguous(), None
    alpha = levels[..., -1]
    return colour.contiguous(), alpha > min(0.5, max(alpha.max().item() / 2, 1e-6))  # alpha may be 0 and 1 of 255


def read_mask(path: Path) -> Bool[Tensor, "height width"]:
    """Where any colour is more than half of the brightest, and alpha, if there is one, is more than half.

    So a mask may be white, in the colour of a label, or in alpha alone. Raises `ValueError` as `read_picture` does, and
    for a grey mask of 0 and 1 in levels of 255, which looks all black.
    """
    colour, alpha = read_picture(path)
    if alpha is not None and (colour == colour[0, 0]).all():
        return alpha
    level = colour.amax(-1)
    brightest = level.max().item()
    grey = (level - colour.amin(-1)).max() < MAX_GREY_DIFFERENCE
    if grey and 0 < brightest <= 0.5:
        raise ValueError(
            f"{path} is nowhere brighter than {255 * brightest:.0f} of 255; a mask is white where the object is, and"
            " black elsewhere"
        )
    bright = level > (0.5 if grey else brightest / 2)
    return bright if alpha is None else bright & alpha


def picture_size(path: Path) -> tuple[int, int]:
    """Height and width in pixels, as stored; raises `ValueError` for a file that is no PNG or JPEG."""
    from PIL import Image

    with error_context(f"{path} cannot be read as a PNG or JPEG image", path):
        with Image.open(path, formats=FORMATS) as file:
            return file.height, file.width


def _levels(path: Path) -> Float[Tensor, "height width channels"]:
    from PIL import Image

    with error_context(f"{path} cannot be read as a PNG or JPEG image", path):
        with Image.open(path, formats=FORMATS) as file:
            full = 65535 if file.mode in SIXTEEN_BIT else 255
            if file.mode in (*EIGHT_BIT, *SIXTEEN_BIT):
                levels = np.array(file)
            else:
                levels = np.array(file.convert("RGBA" if file.has_transparency_data else "RGB"))
    return torch.from_numpy(levels.astype(np.float32) / full).reshape(*levels.shape[:2], -1)
