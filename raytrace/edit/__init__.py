"""Edits of a lens: each returns a new lens, in which everything that refers to a surface has its new number.

scaling     `scale`: by a factor, or to an effective focal length
turning     `reverse`: the whole lens, or a group of its surfaces, turned around
surfaces    `insert`, `delete`, `join`, `split`, `cement`, `bend`, `rename`
sizes       `semi_diameters`: by the rays, with margin, chip zones and mechanical semi-diameters
choice      surfaces by number, range or comment; the error and the warnings of edits
numbering   new numbers in solves, pickups, configurations, merit rows and tolerances
steps       edits one after the other, as words of the command; what they change

The search inserts and removes elements by the same functions. Tests: `tests/test_edit.py`.
"""

from raytrace import namespace

__getattr__, __dir__ = namespace(__name__)
