"""The fork server: a process that has imported all an environment needs, and forks one for each container.

A container's namespaces are made by bubblewrap around a *holder*, a shell that waits. The fork server's child
joins them, gives up every right it has, and becomes the container's environment: no interpreter starts, and
nothing is imported.
"""
