"""The search index after a build of some pages.

Sphinx keeps the words and titles of a page that it does not write again, but not its index entries, such as the terms
of a glossary. Such pages are indexed once more.
"""


def note(app, pagename, templatename, context, doctree):
    """Note a page that is written from a document."""
    if doctree is not None:
        app.search_index_written.add(pagename)


def complete(app):
    """Index the pages that this build did not write."""
    if app.builder.name == "html" and app.builder.search:
        for name in sorted(app.env.all_docs.keys() - app.search_index_written):
            app.builder.write_doc_serialized(name, app.env.get_doctree(name))
    return iter(())


def setup(app):
    app.search_index_written = set()
    app.connect("html-page-context", note)
    app.connect("html-collect-pages", complete)
    return {"parallel_read_safe": True}
