"""Packages of nodes that users bring to an engine, as signed archives with a version.

- :mod:`rce.packages.folder` looks into a package's folder and packs it;
- :mod:`rce.packages.archive` is the archive's form, read without trust;
- :mod:`rce.packages.contents` tells what an archive holds; :mod:`rce.packages.unpacking` puts it on a disk;
- :mod:`rce.packages.signing` makes keys and signatures; :mod:`rce.packages.versions` orders versions.
"""
