"""The study under controlled faults of the cameras: the error of each row against the strength of each fault."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from stereokit_evaluation.data.disturbed import disturbed
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.measures import Measures
from stereokit_evaluation.study.configurations import Configuration
from stereokit_evaluation.study.run import Study, run_study
from stereokit_evaluation.study.store import Store
from stereokit_evaluation.synthetic.disturbances import DISTURBANCES

__all__ = ["FIGURES", "DisturbedStudy", "disturbances_json", "run_disturbances"]

FIGURES = ("d1", "bad-1", "bad-2", "epe", "density")
"""The figures that are shown against the strength."""


@dataclass
class DisturbedStudy:
    """The studies of disturbed frames.

    Attributes
    ----------
    studies : dict
        By kind and strength.
    frames : list of str
        The undisturbed frames' names.
    interrupted : bool
    """

    studies: dict[tuple[str, float], Study] = field(default_factory=dict)
    frames: list[str] = field(default_factory=list)
    interrupted: bool = False

    @property
    def failed(self) -> bool:
        """Whether a frame was left out anywhere."""
        return any(study.skipped for study in self.studies.values())


def run_disturbances(
    frames: Sequence[Frame],
    configurations: Sequence[Configuration],
    store: Store,
    strengths: Mapping[str, Sequence[float]],
    *,
    step: Callable[[str, int], None] = lambda text, advance: None,
    report: Callable[[str], None] = lambda line: None,
) -> DisturbedStudy:
    """Measure and score all configurations on disturbed frames, except for those in the store.

    Parameters
    ----------
    frames : sequence of Frame
        Undisturbed ones.
    configurations : sequence of Configuration
        Finished maps are of undisturbed pairs, and are left out.
    store : Store
    strengths : mapping
        Of each kind, in the order of the table.
    step, report
        As in `run_study`. Warnings about a pair are not reported: that it is disturbed is known.

    Returns
    -------
    DisturbedStudy
        An interrupt ends the work; the strengths so far are returned.
    """
    result = DisturbedStudy(frames=[frame.name for frame in frames])
    movable = [configuration for configuration in configurations if configuration.kind != "maps"]

    def lines(line: str) -> None:
        if not line.startswith("warning: "):
            report(line)

    for kind, values in strengths.items():
        for strength in values:
            study = run_study(
                [disturbed(frame, kind, strength) for frame in frames], movable, store, repeats=1,
                about_times="disturbed", warm_up=False, step=step, report=lines,
            )  # fmt: skip
            result.studies[kind, strength] = study
            if study.interrupted:
                result.interrupted = True
                return result
    return result


def disturbances_json(results: Sequence[tuple[DisturbedStudy, Study]]) -> dict[str, Any]:
    """Return the figures against the strength, pooled over data sets.

    Parameters
    ----------
    results : sequence of (DisturbedStudy, Study)
        Of each data set, with the undisturbed study.

    Returns
    -------
    dict
        By kind: ``unit``, ``views``, ``about``, ``neutral``, ``strengths``, and ``results``: for each row its names,
        ``figures`` (by name, a list as long as ``strengths``), ``images`` (likewise), and ``undisturbed``, the figures
        of the same frames without the fault.
    """
    keys = list(dict.fromkeys(key for disturbed_study, _ in results for key in disturbed_study.studies))
    document: dict[str, Any] = {}
    for kind in dict.fromkeys(kind for kind, _ in keys):
        strengths = [strength for name, strength in keys if name == kind]
        fault = DISTURBANCES[kind]
        document[kind] = {
            "unit": fault.unit, "views": fault.views, "about": fault.about, "neutral": fault.neutral,
            "strengths": strengths, "results": _rows(results, kind, strengths),
        }  # fmt: skip
    return document


def _rows(
    results: Sequence[tuple[DisturbedStudy, Study]], kind: str, strengths: Sequence[float]
) -> list[dict[str, Any]]:
    entries: dict[str, dict[str, Any]] = {}
    for disturbed_study, _ in results:
        for study in disturbed_study.studies.values():
            for row in study.rows:
                names = row.configuration
                entries.setdefault(names.name, {
                    "name": names.name, "label": names.label, "variant": names.variant, "kind": names.kind,
                    "method": names.method,
                })  # fmt: skip
    for name, entry in entries.items():
        pooled: list[Measures] = []
        images: list[int] = []
        for strength in strengths:
            frames = [
                frame
                for disturbed_study, _ in results
                if (kind, strength) in disturbed_study.studies
                for row in disturbed_study.studies[kind, strength].rows
                if row.configuration.name == name
                for frame in row.result.frames
            ]
            pooled.append(sum((frame.measures for frame in frames), Measures()))
            images.append(len(frames))
        clean = [
            frame
            for disturbed_study, study in results
            for row in study.rows
            if row.configuration.name == name
            for frame in row.result.frames
            if frame.name in disturbed_study.frames
        ]
        before = sum((frame.measures for frame in clean), Measures())
        entry["figures"] = {figure: [measures.main.figure(figure) for measures in pooled] for figure in FIGURES}
        entry["images"] = images
        entry["undisturbed"] = {figure: before.main.figure(figure) for figure in FIGURES}
    return list(entries.values())
