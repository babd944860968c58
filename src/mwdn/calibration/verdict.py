"""A PSF's report in words: what is good about it, what to mind, and what to do."""

from collections.abc import Iterator
from typing import Literal, NamedTuple

from mwdn.calibration.report import PsfReport

Weight = Literal["bad", "mind", "good"]
"""``bad`` costs most of the quality, ``mind`` some of it, ``good`` is as it should be."""


class Finding(NamedTuple):
    """One sentence or two, and how much they weigh."""

    weight: Weight
    text: str


def verdict(report: PsfReport) -> tuple[Finding, ...]:
    """Say what the numbers mean, the worst first."""
    parts = (_levels, _light, _detail, _frequencies, _noise, _colours, _places)
    found = [finding for part in parts for finding in part(report)]
    return tuple(sorted(found, key=lambda finding: ("bad", "mind", "good").index(finding.weight)))


def headline(report: PsfReport) -> str:
    """One sentence for everything."""
    weights = [finding.weight for finding in verdict(report)]
    bad, mind = weights.count("bad"), weights.count("mind")
    if bad:
        return f"A poor PSF: {_count(bad, 'fault')} that cost most of the quality. Read on before you use it."
    if mind:
        return f"A usable PSF, with {_count(mind, 'thing')} to mind."
    return "A good PSF: nothing to mind."


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'s' if number > 1 else ''}"


def _percent(part: float) -> str:
    return f"{100 * part:.1f} %" if part < 0.1 else f"{100 * part:.0f} %"


def _levels(report: PsfReport) -> Iterator[Finding]:
    levels = report.levels
    if levels is None:
        return
    if not levels.integers:
        yield Finding("mind", "The file holds floats: whether the sensor was saturated cannot be seen from it.")
    elif levels.saturated > 1:
        text = f"{levels.saturated:,} pixels are at the sensor's maximum: the brightest lines may be cut. Expose less."
        yield Finding("mind", text)
    elif levels.peak < 0.3:
        text = f"The brightest pixel reaches {_percent(levels.peak)} of the full scale: expose longer, for less noise."
        yield Finding("mind", text)
    else:
        yield Finding("good", f"Well exposed: the brightest pixel reaches {_percent(levels.peak)} of the full scale.")
    if 0 < levels.steps < 256:
        text = (
            f"The file has {levels.steps} steps from black to the brightest line; faint light is rounded away. "
            "Save 16 bits, or average frames."
        )
        yield Finding("mind", text)
    yield from _background(report)


def _background(report: PsfReport) -> Iterator[Finding]:
    levels = report.levels
    assert levels is not None
    # Floats have no full scale: their brightest pixel stands for it.
    scale, unit = (1.0, "full scale") if levels.integers else (levels.peak, "brightest pixel")
    level = ", ".join(f"{value / scale:.3f}" for value in levels.background)
    if levels.integers and levels.between - max(levels.subtracted, default=0.0) > 0.05 * levels.peak:
        text = (
            f"Between its lines the file is not black but at {levels.between:.2f} of the full scale, and this was not "
            f"subtracted: the darkest 5 % of the frame are at {level}"
            + (", and that alone was. " if any(levels.subtracted) else ". ")
            + "Take a frame with the source switched off and pass it as `--dark`: what it holds goes, the rest is "
            "light of the mask and belongs to the PSF."
        )
        yield Finding("mind", text)
    if levels.pedestal > 0.02 and not any(levels.subtracted):
        text = (
            f"An even background of {level} of the {unit} holds {_percent(levels.pedestal)} of the light and was "
            "kept. Leave out `--background 0` to have it estimated and subtracted."
        )
        yield Finding("bad" if levels.pedestal > 0.3 else "mind", text)
    elif levels.pedestal > 0.02:
        text = (
            f"An even background of {level} of the {unit}, {_percent(levels.pedestal)} of the file's light, was "
            "estimated and subtracted. Other programs must do so too."
        )
        yield Finding("mind", text)
    else:
        yield Finding("good", "No even background under the whole frame.")


def _light(report: PsfReport) -> Iterator[Finding]:
    s, (height, width) = report.support, report.size
    extent = f"The light covers {s.height} x {s.width} of {height} x {width} pixels"
    if s.border > 0.1:
        text = (
            f"{extent}, and the frame's border is still {_percent(s.border)} as bright as the mean: the PSF is cut, or "
            "has a background. If a larger frame exists, use a larger `--crop`."
        )
        yield Finding("bad" if s.border > 0.5 else "mind", text)
    else:
        yield Finding("good", f"{extent}, all within the frame.")
    off = [abs(d) / n for d, n in zip(s.offset, report.size, strict=True)]
    if max(off) > 0.02:
        down, along = s.offset
        text = (
            f"Its centroid lies {abs(down):.0f} px {'below' if down > 0 else 'above'} and {abs(along):.0f} px to the "
            f"{'right' if along > 0 else 'left'} of the frame's centre, so the field of view lies as far to the other "
            "side: the point source stood off the axis, or the mask does."
        )
        yield Finding("mind" if max(off) > 0.1 else "good", text)
    if s.glow > 0.15:
        text = (
            f"{_percent(s.glow)} of its light fills the lit part evenly: it carries no detail but brings its noise. "
            f"Contrast is {s.contrast:.2f}."
        )
        yield Finding("bad" if s.contrast < 0.4 else "mind", text)
    else:
        yield Finding("good", f"Dark between its lines: contrast {s.contrast:.2f}.")


def _detail(report: PsfReport) -> Iterator[Finding]:
    lobe, (down, along) = report.side_lobe
    if lobe > 0.3:
        text = (
            f"It looks like itself displaced by {down} rows and {along} columns (correlation {lobe:.2f}): expect "
            "ghosts there. An irregular mask has none."
        )
        yield Finding("bad" if lobe > 0.6 else "mind", text)
    else:
        yield Finding("good", f"It repeats itself nowhere: the highest side lobe is {lobe:.2f} of the peak.")
    width = report.peak_width_px
    if width > 8:
        text = (
            f"Its lines are about {width / 2**0.5:.1f} px wide: finer detail comes back faint and noisy. Binning by "
            f"{int(width / 4)} loses little."
        )
        yield Finding("mind", text)
    else:
        yield Finding("good", f"Sharp: its lines are about {width / 2**0.5:.1f} px wide.")


def _frequencies(report: PsfReport) -> Iterator[Finding]:
    if report.dark_rings:
        text = (
            "It sees nothing at "
            + ", ".join(f"{frequency:.3f}" for frequency in report.dark_rings[:4])
            + " cycles per pixel, in any direction: detail of that size is missing from every reconstruction. A "
            "mask in focus, with lines of all directions, has no such rings."
        )
        yield Finding("mind", text)
    if report.weak_part > 0.03:
        text = (
            f"{_percent(report.weak_part)} of the frequencies are nearly dark; of a random mask 1 % are. Straight or "
            "separable structure does that."
        )
        yield Finding("mind", text)
    if not report.dark_rings and report.weak_part <= 0.03:
        text = (
            f"Its spectrum has no dark rings, and {_percent(report.weak_part)} nearly dark places, as a random mask's."
        )
        yield Finding("good", text)
    if report.known_frequency < 0.4:
        text = (
            f"Beyond {report.known_frequency:.2f} cycles per pixel this picture of the PSF is mostly its own noise. "
            "Average more frames."
        )
        yield Finding("mind", text)


def _noise(report: PsfReport) -> Iterator[Finding]:
    told = ", ".join(f"{width:.1f} px at {_percent(noise)}" for noise, width in report.resolution_px.items())
    middle = sorted(report.resolution_px.values())[len(report.resolution_px) // 2]
    gains = ", ".join(f"{report.noise_gain[value] ** 0.5:.3g} at {value:g}" for value in (1e-4, 1e-3, 1e-2))
    text = (
        f"Finest lines that a photograph shows, by the noise of the measurement: {told}. The Wiener estimate "
        f"multiplies this noise, as a standard deviation, by {gains} (lambda)."
    )
    yield Finding("bad" if middle > 16 else "mind" if middle > 8 else "good", text)


def _colours(report: PsfReport) -> Iterator[Finding]:
    if report.colour_likeness < 0.97:
        text = f"Its colours differ (correlation {report.colour_likeness:.2f}): keep all three, a grey PSF would blur."
        yield Finding("bad" if report.colour_likeness < 0.5 else "good", text)


def _places(report: PsfReport) -> Iterator[Finding]:
    for what, by_place in (("distance", report.depth), ("angle", report.angle)):
        if not by_place:
            continue
        kept = [place for place, correlation in by_place.items() if correlation >= 0.7]
        lost = [place for place, correlation in by_place.items() if correlation < 0.7]
        if lost:
            where = f"from {min(kept):g} to {max(kept):g}" if kept else "nowhere else that was asked for"
            text = f"By the {what} of the point it stays alike (correlation 0.7 and more) {where}; at "
            text += ", ".join(f"{place:g}" for place in lost) + " the camera needs another PSF."
        else:
            text = (
                f"It is alike for points of every {what} asked for: correlation {min(by_place.values()):.2f} or more."
            )
        yield Finding("mind" if lost else "good", text)
