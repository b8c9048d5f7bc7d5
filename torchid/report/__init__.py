"""What a run leaves behind: tables, figures, TensorBoard events, parameters and a URDF."""

from torchid.report.parameter_files import identified_urdf, parameters_document

__all__ = ["identified_urdf", "parameters_document"]
