"""What a run leaves behind: metrics, tables, figures, TensorBoard events, parameters and a URDF."""

from torchid.report.metrics import Evaluation, Metrics
from torchid.report.parameters_json import parameters_document
from torchid.report.urdf_export import identified_urdf

__all__ = ["Evaluation", "Metrics", "identified_urdf", "parameters_document"]
