"""A differentiable renderer for neural signed distance functions, by sphere tracing."""

from distrace import threads as threads  # isort: skip

from distrace.boundary import shade as shade
from distrace.camera import Camera as Camera
from distrace.checking.gradcheck import GradientCheck as GradientCheck
from distrace.checking.gradcheck import check_gradients as check_gradients
from distrace.checking.moves import decoder_changes as decoder_changes
from distrace.checkpoints.model import Model as Model
from distrace.checkpoints.model import load_model as load_model
from distrace.checkpoints.model import save_model as save_model
from distrace.data.observation import View as View
from distrace.data.observation import load_view as load_view
from distrace.fields.base import SDF as SDF
from distrace.fields.base import chunked as chunked
from distrace.fields.base import placed as placed
from distrace.fitting.fit import FitConfig as FitConfig
from distrace.fitting.fit import fit_shape as fit_shape
from distrace.fitting.fit_camera import CameraConfig as CameraConfig
from distrace.fitting.fit_camera import fit_camera as fit_camera
from distrace.mesh import MeshConfig as MeshConfig
from distrace.mesh import extract_mesh as extract_mesh
from distrace.metrics import chamfer as chamfer
from distrace.prior import prior_of as prior_of
from distrace.rays import Bounds as Bounds
from distrace.rays import Rays as Rays
from distrace.rays import meet_sphere as meet_sphere
from distrace.render import Buffers as Buffers
from distrace.render import render as render
from distrace.surface import attach as attach
from distrace.surface import clearance as clearance
from distrace.surface import footprint_normals as footprint_normals
from distrace.surface import normals as normals
from distrace.tracing.bounds import Occupancy as Occupancy
from distrace.tracing.sphere_tracing import Outcome as Outcome
from distrace.tracing.sphere_tracing import Trace as Trace
from distrace.tracing.sphere_tracing import TraceConfig as TraceConfig
from distrace.tracing.sphere_tracing import sphere_trace as sphere_trace
from distrace.tracing.tracer import TracerConfig as TracerConfig
