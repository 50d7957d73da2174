"""Draws the weights of primitives as bars into a corner of a picture."""

from collections.abc import Sequence

from PIL import Image, ImageDraw, ImageFont

from torchrl_mcp.analysis.figures import FAINT, INK, colours

ROW, LENGTH = 1 / 22, 1 / 4
"""Height of a row, and length of a bar of weight 1, relative to the height of the picture."""


def draw_bars(picture: Image.Image, weights: Sequence[float], title: str) -> None:
    """Draw weights as numbered bars into the upper left corner, each on a track that shows weight 1.

    Args:
        picture: RGB picture, changed in place.
        weights: Weights of primitives 1, 2, ..., from 0 to 1.
        title: Title of the bars.
    """
    draw = ImageDraw.Draw(picture)
    row = round(picture.height * ROW)
    length = round(picture.height * LENGTH)
    font = ImageFont.load_default(0.8 * row)
    left = 2 * row
    top = 2 * row
    gap = max(1, row // 6)
    plate = (row // 2, row // 3, left + length + row // 2, top + len(weights) * row + row // 3)
    corner = picture.crop(plate)
    picture.paste(Image.blend(corner, Image.new("RGB", corner.size, "white"), 0.6), plate)
    draw.text((row, row), title, fill=INK, font=font, anchor="lm")
    for number, (weight, colour) in enumerate(zip(weights, colours(len(weights)), strict=True)):
        y = top + number * row
        draw.text((1.5 * row, y + row / 2), str(number + 1), fill=INK, font=font, anchor="mm")
        for fill, right in ((FAINT, length), (colour, round(length * min(max(weight, 0.0), 1.0)))):
            if right:
                draw.rectangle((left, y + gap, left + right - 1, y + row - gap), fill=fill)
