"""Geometry without opinions: rigid transforms, kinematic trees, boxes and triangle meshes; numpy in, numpy out."""
