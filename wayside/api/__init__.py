"""The five kinds of wayside.dev/v1alpha1: the single source of the CRDs, the checks and the documentation."""

from wayside.api.applicationinstance import ApplicationInstance
from wayside.api.applicationtask import ApplicationTask
from wayside.api.applicationtemplate import ApplicationTemplate
from wayside.api.base import API_VERSION, GROUP, VERSION, Kind
from wayside.api.detector import Detector
from wayside.api.eventrule import EventRule

KINDS: dict[str, type[Kind]] = {
    kind.__name__: kind for kind in (EventRule, Detector, ApplicationTemplate, ApplicationTask, ApplicationInstance)
}
"""The kinds by their names."""

__all__ = [
    "API_VERSION",
    "GROUP",
    "KINDS",
    "VERSION",
    "ApplicationInstance",
    "ApplicationTask",
    "ApplicationTemplate",
    "Detector",
    "EventRule",
    "Kind",
]
