from raytrace.edit.scaling import scale as scale
from raytrace.edit.surfaces import bend as bend
from raytrace.edit.surfaces import delete as delete
from raytrace.edit.surfaces import insert as insert
from raytrace.edit.surfaces import join as join
from raytrace.edit.surfaces import rename as rename
from raytrace.edit.surfaces import split as split
from raytrace.edit.turning import reverse as reverse
