"""studies.focusing"""
