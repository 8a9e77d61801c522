"""A differentiable renderer for neural signed distance functions, by sphere tracing."""

from distrace import threads as threads  # isort: skip

from distrace.boundary import shade as shade
from distrace.camera import Camera as Camera
from distrace.checking.gradcheck import GradientCheck as GradientCheck
from distrace.checking.gradcheck import check_gradients as check_gradients
from distrace.checking.moves import decoder_changes as decoder_changes
from distrace.checkpoint import Model as Model
from distrace.checkpoint import load_model as load_model
from distrace.checkpoint import save_model as save_model
from distrace.data.view import View as View
from distrace.data.view import load_view as load_view
from distrace.field import SDF as SDF
from distrace.field import chunked as chunked
from distrace.field import placed as placed
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
from distrace.trace import Outcome as Outcome
from distrace.trace import Trace as Trace
from distrace.trace import TraceConfig as TraceConfig
from distrace.trace import sphere_trace as sphere_trace
from distrace.tracing.bounds import Occupancy as Occupancy
from distrace.tracing.tracer import TracerConfig as TracerConfig
