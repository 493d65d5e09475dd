# ruff: noqa: I001
from raytrace.tracing.base_ray import BaseRay as BaseRay
from raytrace.tracing.base_ray import base_ray as base_ray
from raytrace.tracing.compiled import prepare as prepare
from raytrace.tracing.compiled import trace_engine as trace_engine
from raytrace.tracing.launch import rays as rays
from raytrace.tracing.lens_report import info as info
from raytrace.tracing.paraxial import FirstOrder as FirstOrder
from raytrace.tracing.paraxial import first_order as first_order
from raytrace.tracing.paraxial import paraxial_image_distance as paraxial_image_distance
from raytrace.tracing.ray_listing import trace as trace
from raytrace.tracing.scene import Memo as Memo
from raytrace.tracing.spot import Spot as Spot
from raytrace.tracing.streaming import mean_square_gradient as mean_square_gradient
