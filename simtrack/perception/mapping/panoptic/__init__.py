"""Panoptic volumetric mapping: from RGB-D images and noisy segments to one mesh an entity.

Section 3 of the reconstruction paper (Eqs. 4-6) on a truncated signed distance field (TSDF) that exists only in blocks
around surfaces.

    panoptic_map = PanopticMap(PanopticMapConfig(voxel=0.02))
    for frame, T_map_camera in source:
        panoptic_map.integrate(frame, T_map_camera, segmenter.segment(frame))
    entities = panoptic_map.entities()
"""
