"""Numbers as people read them in the report and on the terminal."""

import math

from ..methods import METHODS


def number(value, digits=3):
    """A number with some significant digits; a dash for none."""
    if value is None:
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if math.isnan(value):
        return "undefined"
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    if not exponent:
        return mantissa.replace("-", "−")
    if 0 <= int(exponent) < 6:
        return f"{float(mantissa) * 10 ** int(exponent):.0f}".replace("-", "−")
    return power_of_ten(mantissa, int(exponent))


def power_of_ten(mantissa, exponent):
    """`mantissa` times a power of ten, in typeset form."""
    raised = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa}·10{raised}".replace("-", "−")


def signed(value, digits=2):
    """A number with its sign."""
    if value is None or not math.isfinite(value):
        return number(value)
    return ("+" if value > 0 else "") + number(value, digits)


def percent(value):
    """A share in percent with its sign."""
    return "–" if value is None else f"{100 * value:+.1f} %".replace("-", "−")


def bytes_text(value):
    """Bytes in decimal units, as in the papers; a dash for none."""
    if value is None:
        return "–"
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if value >= size:
            return f"{value / size:.3g} {unit}" if value < 999.5 * size else f"{value / size:.0f} {unit}"
    return f"{value} B"


def seconds_text(value, digits=2):
    """Seconds with their unit."""
    return "–" if value is None else f"{number(value, digits)}\u00a0s"


def interval(estimate, digits=2):
    """A confidence interval in brackets; nothing where none is known."""
    return f"[{number(estimate.low, digits)}, {number(estimate.high, digits)}]" if estimate.certain else ""


def with_interval(estimate, digits=3):
    """An estimate and its confidence interval."""
    return f"{number(estimate.value, digits)} {interval(estimate, digits)}".strip()


def method_label(method):
    """The name of a method for people."""
    return METHODS[method].label if method in METHODS else method.capitalize()


def short_label(item):
    """Method and footprint rule, where the legend says what is what."""
    return method_label(item.method) + ("" if item.footprint == "none" else f" · {item.footprint}")


def long_label(item):
    """Method and footprint rule in full."""
    return method_label(item.method) + ("" if item.footprint == "none" else f" · footprint: {item.footprint}")


def scene_title(scene):
    """Name of a scene for people."""
    return scene.replace("_", " ").capitalize()


def case_id(scene, tiling):
    """Name of a scene at a tiling in files and links."""
    return f"{scene}-x{tiling:g}"


def case_title(scene, tiling):
    """Name of a scene at a tiling for people."""
    return f"{scene_title(scene)} ×{tiling:g}"


def view_title(view):
    """Name of a view for people: "frame", "crop 1"."""
    return view.replace("crop", "crop ")


def sample_text(item):
    """The samples or the time budget of a summary."""
    budget = f"{item.spp}\u00a0spp"
    if item.time_budget is None:
        return budget
    return f"{budget} in {item.time_budget:g} s" + (" with build" if item.budget_includes_build else "")
