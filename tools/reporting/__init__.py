"""Reports: one self-contained HTML page, used by every verb that has more to show than a table.

    from jointctl.tools.reporting.page import Section, Table, page, svg_figure, write_page

    table = Table(["controller", "RMSE [mrad]"], rows)
    picture = svg_figure(figure, "what it shows", "what to note in it")  # a matplotlib figure
    write_page(path, page("Study", [Section("Errors", [table, picture])]), inputs)

Nothing is fetched from anywhere: styles and figures are in the file.  It follows the reader's light or dark scheme and
prints in black on white.
"""
