"""studies.edof"""
