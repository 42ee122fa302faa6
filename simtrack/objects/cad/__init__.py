"""CAD catalogue: rigid and articulated furniture and household models, by class, and users' own."""

from simtrack.objects.cad.library import CAD_CLASSES, cad_classes, cad_model, cad_models
from simtrack.objects.cad.model import CadBox, CadJoint, CadModel, CadPart, CadPlane, CadSupport

__all__ = [
    "CAD_CLASSES",
    "CadBox",
    "CadJoint",
    "CadModel",
    "CadPart",
    "CadPlane",
    "CadSupport",
    "cad_classes",
    "cad_model",
    "cad_models",
]
