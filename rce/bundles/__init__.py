"""Bundles: packages of nodes that users bring to an engine, as signed archives with a version.

- :mod:`rce.bundles.folder` looks into a package's folder and packs it;
- :mod:`rce.bundles.archive` is the archive's form, read without trust;
- :mod:`rce.bundles.contents` tells what an archive holds; :mod:`rce.bundles.unpacking` lays it out on a disk;
- :mod:`rce.bundles.signing` makes keys and signatures; :mod:`rce.bundles.versions` orders versions.
"""
