"""Workshop: drawings and solids of the elements of a lens.

parts           elements as solids of revolution: exact profiles, diameters, chamfers, volume
indications     tolerances of a lens as the indications of ISO 10110
sheets          `draw`: sheets of elements, groups and the whole lens; their figures (.pdf, .svg, .png)
dxf, step       profiles as DXF entities, solids as STEP: of the extra `cad`
"""
