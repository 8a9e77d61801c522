"""The public names, which `import distrace` offers."""

from distrace import lights, losses
from distrace.boundary import shade
from distrace.camera import Camera
from distrace.checking.gradcheck import GradientCheck, check_gradients
from distrace.checking.moves import decoder_changes
from distrace.checkpoints.model import Model, load_model, save_model
from distrace.data.observation import View, load_view
from distrace.errors import DoubtfulResult
from distrace.fields import primitives
from distrace.fields.base import SDF, chunked, placed
from distrace.fields.batch import BatchField
from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.fitting.fit import FitConfig, fit_shape
from distrace.fitting.fit_camera import CameraConfig, fit_camera
from distrace.fitting.fit_code import CodeFitConfig, fit_code
from distrace.mesh import MeshConfig, extract_mesh
from distrace.metrics import Chamfer, chamfer
from distrace.pose import Similarity, exp_se3, pose_error
from distrace.prior import Prior, prior_of
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.render import Buffers, render
from distrace.surface import attach, clearance, footprint_normals, normals
from distrace.tracing.bounds import Occupancy
from distrace.tracing.sphere_tracing import Outcome, Trace, TraceConfig, sphere_trace
from distrace.tracing.tracer import TracerConfig
from distrace.viewer.page import view

__all__ = [
    "SDF",
    "BatchField",
    "Bounds",
    "Buffers",
    "Camera",
    "CameraConfig",
    "Chamfer",
    "CodeFitConfig",
    "Decoder",
    "DoubtfulResult",
    "FitConfig",
    "GradientCheck",
    "MeshConfig",
    "Model",
    "NetworkSpecs",
    "Occupancy",
    "Outcome",
    "Prior",
    "Rays",
    "Similarity",
    "Trace",
    "TraceConfig",
    "TracerConfig",
    "View",
    "attach",
    "chamfer",
    "check_gradients",
    "chunked",
    "clearance",
    "decoder_changes",
    "exp_se3",
    "extract_mesh",
    "fit_camera",
    "fit_code",
    "fit_shape",
    "footprint_normals",
    "lights",
    "load_model",
    "load_view",
    "losses",
    "meet_sphere",
    "normals",
    "placed",
    "pose_error",
    "primitives",
    "prior_of",
    "render",
    "save_model",
    "shade",
    "sphere_trace",
    "view",
]
