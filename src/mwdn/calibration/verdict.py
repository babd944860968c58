"""The verdict on a PSF: what is good about it, what is not, and what to do."""

import math
from collections.abc import Iterator
from typing import Literal, NamedTuple

from mwdn.calibration.report import Levels, PsfReport
from mwdn.calibration.size_advice import MIN_PSF_PX

Weight = Literal["bad", "weak", "good"]
"""``bad`` costs most of the quality, ``weak`` some of it, ``good`` none."""


class Finding(NamedTuple):
    """A statement about a PSF, and how much it matters."""

    weight: Weight
    text: str


def verdict(report: PsfReport) -> tuple[Finding, ...]:
    """Say what the numbers of a report mean, the worst first."""
    parts = (_size, _levels, _sensor, _light, _detail, _frequencies, _noise, _colours, _places)
    findings = [finding for part in parts for finding in part(report)]
    return tuple(sorted(findings, key=lambda finding: ("bad", "weak", "good").index(finding.weight)))


def headline(report: PsfReport) -> str:
    """Summarise the verdict in one sentence."""
    weights = [finding.weight for finding in verdict(report)]
    bad, weak = weights.count("bad"), weights.count("weak")
    if bad:
        return f"A poor PSF: {_count(bad, 'fault')} that cost{'' if bad > 1 else 's'} most of the quality."
    if weak:
        return f"A usable PSF with {_count(weak, 'weakness', 'weaknesses')}."
    return "A good PSF: no weaknesses."


def _count(number: int, singular: str, plural: str = "") -> str:
    return f"{number} {singular if number == 1 else plural or singular + 's'}"


def _percent(part: float) -> str:
    return f"{100 * part:.1f} %" if part < 0.1 else f"{100 * part:.0f} %"


def _size(report: PsfReport) -> Iterator[Finding]:
    height, width = report.size
    if min(height, width) < MIN_PSF_PX:
        text = (
            f"It has {height} x {width} pixels, but `mwdn reconstruct` needs {MIN_PSF_PX} along each side. Take the "
            "whole frame of the sensor, or crop and bin it less: `--crop`, `--bin`, `--psf-bin`."
        )
        yield Finding("bad", text)


def _levels(report: PsfReport) -> Iterator[Finding]:
    levels = report.levels
    if levels is None:
        return
    if not levels.integers and report.corrected:
        decades = math.log10(max(levels.peak / max(levels.noise, 1e-12), 1.0))
        text = f"Averaged and corrected: {decades:.1f} decades from the noise to the brightest pixel."
        # The tails of a PSF lie three decades below its peak.
        if decades < 3:
            yield Finding("weak", f"{text} Average more frames, or merge exposures, to see its tails.")
        else:
            yield Finding("good", text)
    elif not levels.integers:
        yield Finding("weak", "The file holds floats, so saturation of the sensor cannot be detected.")
    elif levels.saturated > 1:
        text = f"{levels.saturated:,} pixels are at the sensor's maximum: the brightest lines may be cut. Expose less."
        yield Finding("weak", text)
    elif levels.peak < 0.3:
        bits = levels.possible_bit_depth
        text = f"The brightest pixel reaches only {_percent(levels.peak)} of the full scale. Expose longer" + (
            f", unless the sensor has {bits} bits: `--bit-depth {bits}`." if bits else "."
        )
        yield Finding("weak", text)
    else:
        yield Finding("good", f"Well exposed: the brightest pixel reaches {_percent(levels.peak)} of the full scale.")
    if 0 < levels.largest < 256:
        text = (
            f"The file has {levels.largest} levels from black to the brightest line, so faint light is rounded away. "
            "Save 16 bits, or average frames."
        )
        yield Finding("weak", text)
    if levels.below_zero > 0.01:
        text = (
            f"{_percent(levels.below_zero)} of its pixels are far below 0 and count as 0: more was subtracted than the "
            "background, so the PSF has lost its faint parts. Use the picture before the subtraction."
        )
        yield Finding("bad" if levels.below_zero > 0.2 else "weak", text)
    yield from _background(levels)


def _sensor(report: PsfReport) -> Iterator[Finding]:
    if report.defects is not None:
        yield Finding("good", f"{report.defects:,} hot or dead pixels are replaced in every frame.")
    if (sensor := report.sensor) is not None:
        # A bright pixel: the square root of its electrons. A dark one: the read noise.
        text = (
            f"Sensor: full well {sensor.full_well:,.0f} electrons, so a bright pixel has {sensor.full_well**-0.5:.2%} "
            f"noise; read noise {sensor.read_noise:.2g} electrons."
        )
        yield Finding("good", text)


def _background(levels: Levels) -> Iterator[Finding]:
    # Floats have no full scale: levels are relative to their brightest pixel.
    scale, unit = (1.0, "full scale") if levels.integers else (levels.peak, "brightest pixel")
    level, subtracted = (
        ", ".join(f"{value / scale:.3f}" for value in values) for values in (levels.background, levels.subtracted)
    )
    if (
        levels.integers
        and not levels.has_dark
        and levels.between - max(levels.subtracted, default=0.0) > 0.05 * levels.peak
    ):
        text = (
            f"Between its lines the PSF is at {levels.between:.2f} of the full scale, but "
            + (f"only {subtracted} was subtracted" if any(levels.subtracted) else "no background was subtracted")
            + f"; the darkest 5 % of the frame are at {level}. Take a frame with the source switched off and pass it "
            "as `--dark`: this removes stray light and keeps light from the mask, which belongs to the PSF."
        )
        yield Finding("weak", text)
    excess = max(levels.subtracted, default=0.0) - max(levels.between, *levels.background)
    if levels.integers and excess > 0.05 * levels.peak:
        text = (
            f"{subtracted} of the full scale was subtracted, but the darkest 5 % of the frame are at {level}: the PSF "
            "has lost its faint parts. Leave out `--background`, which estimates it."
        )
        yield Finding("bad" if excess > 0.2 * levels.peak else "weak", text)
    elif levels.pedestal > 0.02 and not any(levels.subtracted):
        text = (
            f"A uniform background of {level} of the {unit} contains {_percent(levels.pedestal)} of the light and was "
        )
        if levels.has_dark:
            text += (
                "kept: after a dark frame it is light that the mask scatters, which belongs to the PSF. To subtract it "
                'nevertheless, set `background = "estimate"` in the camera file.'
            )
        else:
            text += "kept. Leave out `--background 0` to estimate and subtract it."
        yield Finding("bad" if levels.pedestal > 0.3 else "good" if levels.has_dark else "weak", text)
    elif levels.pedestal > 0.02:
        whole = max(abs(a - b) for a, b in zip(levels.background, levels.subtracted, strict=True)) < 0.005 * scale
        text = (
            f"A uniform background of {level} of the {unit}, {_percent(levels.pedestal)} of the file's light, was "
            f"{'subtracted' if whole else f'found, and {subtracted} subtracted'}. Other programs that use this file "
            "must do the same."
        )
        yield Finding("weak", text)
    else:
        yield Finding("good", "No uniform background.")


def _light(report: PsfReport) -> Iterator[Finding]:
    support, (height, width) = report.support, report.size
    extent = f"The light covers {support.height} x {support.width} of {height} x {width} pixels"
    if support.border > 0.1:
        text = (
            f"{extent}, but the border of the frame is still {_percent(support.border)} as bright as the mean: the PSF "
            "is cut off, or has a background. If the frame is larger, take more of it: `--crop`."
        )
        yield Finding("bad" if support.border > 0.5 else "weak", text)
    else:
        yield Finding("good", f"{extent}, all within the frame.")
    off_centre = max(abs(offset) / length for offset, length in zip(support.offset, report.size, strict=True))
    if off_centre > 0.02:
        down, right = support.offset
        text = (
            f"Its centroid is {abs(down):.0f} px {'below' if down > 0 else 'above'} and {abs(right):.0f} px to the "
            f"{'right' if right > 0 else 'left'} of the frame's centre, so the field of view is shifted to the "
            "opposite side by as much: the point source or the mask was off the axis."
        )
        yield Finding("weak" if off_centre > 0.1 else "good", text)
    if support.glow > 0.15:
        text = (
            f"{_percent(support.glow)} of its light is spread uniformly over the lit area: it carries no detail, but "
            f"adds noise. Contrast is {support.contrast:.2f}."
        )
        yield Finding("bad" if support.contrast < 0.4 else "weak", text)
    else:
        yield Finding("good", f"Dark between its lines: contrast {support.contrast:.2f}.")


def _detail(report: PsfReport) -> Iterator[Finding]:
    lobe, (rows, columns) = report.side_lobe
    if lobe > 0.3:
        text = (
            f"It repeats itself {rows} rows and {columns} columns away (correlation {lobe:.2f}): expect ghosts at this "
            "distance. An irregular mask has none."
        )
        yield Finding("bad" if lobe > 0.6 else "weak", text)
    else:
        yield Finding("good", f"It does not repeat itself: the highest side lobe is {lobe:.2f} of the peak.")
    width = report.peak_width_px
    if width > 8:
        text = f"Its lines are about {width / 2**0.5:.1f} px wide: finer detail is reconstructed faint and noisy."
        if report.coarsest_bin > report.bin:
            text += f" Binning loses little: `--bin {report.coarsest_bin}`, the default of `mwdn reconstruct`."
        yield Finding("weak", text)
    else:
        yield Finding("good", f"Sharp: its lines are about {width / 2**0.5:.1f} px wide.")


def _frequencies(report: PsfReport) -> Iterator[Finding]:
    if report.dark_rings:
        text = (
            "No signal at "
            + ", ".join(f"{frequency:.3f}" for frequency in report.dark_rings[:4])
            + " cycles per pixel in any direction: detail of this size is missing from every reconstruction. A mask "
            "in focus, with lines in all directions, has no such rings."
        )
        yield Finding("weak", text)
    if report.weak_part > 0.03:
        text = (
            f"{_percent(report.weak_part)} of the frequencies are nearly dark; for a random mask it is 1 %. Straight "
            "lines and separable patterns cause this."
        )
        yield Finding("weak", text)
    if not report.dark_rings and report.weak_part <= 0.03:
        text = (
            f"Its spectrum has no dark rings, and {_percent(report.weak_part)} of its frequencies are nearly dark; for "
            "a random mask it is 1 %."
        )
        yield Finding("good", text)
    if report.known_frequency < 0.4:
        text = (
            f"Above {report.known_frequency:.2f} cycles per pixel this picture of the PSF is mostly noise. Average "
            "more frames."
        )
        yield Finding("weak", text)


def _noise(report: PsfReport) -> Iterator[Finding]:
    widths = ", ".join(
        f"{f'{width:.1f} px' if math.isfinite(width) else 'none'} at {_percent(noise)}"
        for noise, width in report.resolution_px.items()
    )
    middle = sorted(report.resolution_px.values())[len(report.resolution_px) // 2]
    gains = ", ".join(f"{report.noise_gain[value] ** 0.5:.3g} at {value:g}" for value in (1e-4, 1e-3, 1e-2))
    text = (
        f"Finest visible lines of a photograph, by the noise of the measurement: {widths}. The Wiener estimate "
        f"multiplies the standard deviation of this noise, by lambda: {gains}."
    )
    yield Finding("bad" if middle > 16 else "weak" if middle > 8 else "good", text)


def _colours(report: PsfReport) -> Iterator[Finding]:
    if report.colour_likeness < 0.97:
        text = f"Its colours differ (correlation {report.colour_likeness:.2f}): use all three. A grey PSF would blur."
        yield Finding("bad" if report.colour_likeness < 0.5 else "good", text)


def _places(report: PsfReport) -> Iterator[Finding]:
    places = {
        ("distance", " mm"): report.depth,
        ("angle", " degrees"): report.angle,
        ("displacement", " raw pixels"): report.off_axis,
    }
    for (what, unit), by_place in places.items():
        if not by_place:
            continue
        valid = [place for place, correlation in by_place.items() if correlation >= 0.7]
        invalid = [place for place, correlation in by_place.items() if correlation < 0.7]
        if invalid:
            where = f"from {min(valid):g} to {max(valid):g}{unit}" if valid else "nowhere else"
            text = f"By {what} of the point, this PSF is valid (correlation 0.7 or more) {where}; at "
            text += ", ".join(f"{place:g}" for place in invalid) + f"{unit} the camera needs another PSF."
        else:
            text = f"This PSF is valid at every {what} compared: correlation {min(by_place.values()):.2f} or more."
        yield Finding("weak" if invalid else "good", text)
