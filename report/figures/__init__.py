"""Figures of a study for a paper: `report.figures.figure_files.write_figures`.

What they show comes from `report.series`, as what the page shows does. A function that draws is
handed axes and numbers, and writes nothing.
"""
