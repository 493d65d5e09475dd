"""studies.codesign"""
