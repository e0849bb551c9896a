"""The depth estimators by name, behind one interface."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.bank import Bank
from calibration.errors import CalibrationError
from calibration.field import bank_at, region_place
from calibration.image import LinearImage
from workbench.depth.estimate import DepthEstimate
from workbench.depth.evidence import EvidenceOptions, estimate_evidence
from workbench.depth.references.bae_durand import BaeDurandOptions, estimate_bae_durand
from workbench.depth.references.elder_zucker import ElderZuckerOptions, estimate_elder_zucker
from workbench.depth.references.levin import LevinOptions, estimate_levin
from workbench.depth.references.pair import PairOptions, estimate_pair
from workbench.depth.references.pentland import PentlandOptions, estimate_pentland
from workbench.depth.references.second_view import SecondViewOptions
from workbench.depth.references.zhuo_sim import ZhuoSimOptions, estimate_zhuo_sim
from workbench.depth.sharpness import SharpnessOptions, estimate_sharpness
from workbench.processors import each

Estimator = Callable[..., dict[int, DepthEstimate]]


@dataclass(frozen=True, slots=True)
class Method:
    """One estimator.

    Attributes
    ----------
    name
        As in ``measure --method``.
    source
        Where it is published.
    estimate
        ``estimate(image, bank, labels, options)``: depth per label.
    options
        Dataclass of its constants.
    in_threads
        Whether ``estimate`` also takes ``workers``.
    knows_outlines
        Whether it also takes ``outlines_found``.
    over_field
        Whether it takes banks over the field as they are; others get that of a region's place, for each region.
    """

    name: str
    source: str
    estimate: Estimator
    options: type
    in_threads: bool = False
    knows_outlines: bool = False
    over_field: bool = False


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method(
            "evidence",
            "this project, docs/explanation/evidence.md",
            estimate_evidence,
            EvidenceOptions,
            in_threads=True,
            knows_outlines=True,
            over_field=True,
        ),
        Method("sharpness", "Kim 2021, sharpness assessment", estimate_sharpness, SharpnessOptions, in_threads=True),
        Method("levin", "Levin, Fergus, Durand and Freeman 2007", estimate_levin, LevinOptions),
        Method("pair", "Zhou, Lin and Nayar 2009", estimate_pair, PairOptions),
        Method("zhuo-sim", "Zhuo and Sim 2011", estimate_zhuo_sim, ZhuoSimOptions),
        Method("bae-durand", "Bae and Durand 2007", estimate_bae_durand, BaeDurandOptions),
        Method("elder-zucker", "Elder and Zucker 1998", estimate_elder_zucker, ElderZuckerOptions),
        Method("pentland", "Pentland 1987, two settings", estimate_pentland, PentlandOptions),
    )
}
DEFAULT_METHOD = "evidence"


class MethodError(CalibrationError):
    """Unknown method, unknown option of a method, or a value that isn't one."""


def needs_second_view(method: str) -> bool:
    """Whether a method measures two photographs at once (options ``second_image`` and ``second_bank``)."""
    found = METHODS.get(method)
    return found is not None and issubclass(found.options, SecondViewOptions)


def make_options(method: str, settings: Mapping[str, Any]) -> tuple[Method, Any]:
    """Find a method and build its options from texts; photographs and banks are given as such.

    Raises
    ------
    MethodError
        Names what is unknown and the nearest known.
    """
    found = METHODS.get(method)
    if found is None:
        raise MethodError(f"--method {method}: unknown; known are {', '.join(METHODS)}")
    hints = typing.get_type_hints(found.options)
    values: dict[str, Any] = {}
    for name, value in settings.items():
        if name not in hints:
            near = difflib.get_close_matches(name, hints, n=1, cutoff=0.4)
            hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(hints)}"
            raise MethodError(f"--set {name}: method {method} has no such option; {hint}")
        values[name] = _convert(name, value, hints[name]) if isinstance(value, str) else value
    try:
        return found, found.options(**values)
    except ValueError as error:
        raise MethodError(f"--set: {error}") from None


def _convert(name: str, text: str, kind: Any) -> Any:
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        if text.lower() == "none":
            return None
        kind = next(k for k in typing.get_args(kind) if k is not type(None))
    if typing.get_origin(kind) is typing.Literal:
        choices = typing.get_args(kind)
        if text not in choices:
            raise MethodError(f"--set {name}={text}: choose one of {', '.join(map(str, choices))}")
        return text
    if typing.get_origin(kind) is tuple:
        return tuple(_convert(name, part.strip(), typing.get_args(kind)[0]) for part in text.split(","))
    if kind in (LinearImage, Bank):
        raise MethodError(f"--set {name}={text}: give the {'photograph' if kind is LinearImage else 'bank'} itself")
    if dataclasses.is_dataclass(kind):
        raise MethodError(f"--set {name}: is made of several numbers and can't be set from the command line")
    if kind is bool:
        if text.lower() not in ("true", "false", "yes", "no"):
            raise MethodError(f"--set {name}={text}: give true or false")
        return text.lower() in ("true", "yes")
    try:
        return kind(text)
    except ValueError:
        wanted = "a whole number" if kind is int else "a number"
        raise MethodError(f"--set {name}={text}: give {wanted}") from None


def estimate_depths(
    image: LinearImage,
    bank: Bank,
    labels: NDArray[np.int32],
    method: str,
    settings: Mapping[str, Any],
    *,
    workers: int = 1,
    outlines_found: bool = False,
) -> dict[int, DepthEstimate]:
    """Depth of every labelled region.

    Parameters
    ----------
    image
        Developed by the bank's recipe.
    bank
        PSFs; of one over the field, each region is measured by those of its centroid's place.
    labels
        int32 (H, W), 0 = no region.
    method, settings
        Name of the estimator and its options as texts; photographs and banks among them as such.
    workers
        Threads for methods that can use them; no answer depends on their number.
    outlines_found
        Whether the regions' outlines were found in the photograph; methods that know of it claim less then.

    Raises
    ------
    MethodError
        See :func:`make_options`.
    """
    chosen, options = make_options(method, settings)
    told = {"outlines_found": outlines_found} if chosen.knows_outlines else {}
    threads = {"workers": workers} if chosen.in_threads else {}
    if len(bank.field_yx) == 1 or chosen.over_field:
        return chosen.estimate(image, bank, labels, options, **told, **threads)

    def in_place(label: int) -> dict[int, DepthEstimate]:
        mask = labels == label
        here = bank_at(bank, region_place(mask))
        return chosen.estimate(image, here, np.where(mask, labels, 0).astype(np.int32), options, **told)

    parts = each(in_place, np.unique(labels[labels > 0]).tolist(), threads.get("workers", 1))
    return {label: estimate for part in parts for label, estimate in part.items()}


def option_values(method: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Every constant that a measurement will use, for its provenance; photographs and banks by hash and id."""
    options = make_options(method, settings)[1]
    return {field.name: _provenance(getattr(options, field.name)) for field in dataclasses.fields(options)}


def _provenance(value: Any) -> Any:
    if isinstance(value, LinearImage):
        return {"path": value.info.path, "sha256": value.info.sha256}
    if isinstance(value, Bank):
        return value.id
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value
