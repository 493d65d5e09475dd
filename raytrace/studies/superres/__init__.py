"""studies.superres"""
