"""Motion capture of others: BVH, C3D and CSV enter, hand motions leave."""
