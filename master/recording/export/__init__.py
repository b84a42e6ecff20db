"""Export: recorded hands enter, CSV, Parquet, BVH, glTF and Rerun files leave."""
