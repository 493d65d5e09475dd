"""studies.quantise"""
