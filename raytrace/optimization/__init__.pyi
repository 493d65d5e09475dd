# ruff: noqa: I001
from raytrace.optimization.evaluate import evaluate as evaluate
from raytrace.optimization.file_check import check as check
from raytrace.optimization.merit import DefaultMerit as DefaultMerit
from raytrace.optimization.merit import Merit as Merit
from raytrace.optimization.operands.operand import Conventions as Conventions
from raytrace.optimization.operands.operand import Measure as Measure
from raytrace.optimization.optimize import Optimized as Optimized
from raytrace.optimization.optimize import optimize as optimize
from raytrace.optimization.problem import Condition as Condition
from raytrace.optimization.search import Searched as Searched
from raytrace.optimization.search import search as search
