"""Sphinx extension: turn a code span into a link if the site has a page for what it names.

`docs/envs.md` becomes that page's title; `surgicai_vision/envs/base.py` and
`surgicai_vision.envs.base` link to the reference, `examples/environment.py` to the example,
`surgicai-vision train` to the verb. The pages stay readable in the repository, where the same words
are paths.
"""

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform

from surgicai_vision.commands import COMMANDS, PROGRAM


class LinkCodeSpans(SphinxPostTransform):
    """Replace code spans that name a page with links to it."""

    default_priority = 4  # before Sphinx resolves references

    def run(self, **arguments: object) -> None:
        """Visit the code spans of one document."""
        python = {
            name: (entry.docname, entry.node_id)
            for name, entry in self.env.domains.python_domain.objects.items()
        }
        for node in list(self.document.findall(nodes.literal)):
            if isinstance(node.parent, nodes.reference | addnodes.pending_xref | nodes.title):
                continue
            text = node.astext()
            module = text.removesuffix("/").removesuffix(".py").replace("/", ".")
            page, anchor = page_of(text, self.env.docname), ""
            if "." in module and not page:
                page, anchor = python.get(module, ("", ""))
            if page in self.env.all_docs and page != self.env.docname:
                address = self.app.builder.get_relative_uri(self.env.docname, page)
                address += f"#{anchor}" if anchor else ""
                link = nodes.reference("", "", internal=True, refuri=address)
                node.replace_self(link)
                is_page = text.startswith("docs/")
                link += nodes.Text(self.env.titles[page].astext()) if is_page else node


def page_of(text: str, seen_from: str) -> str:
    """Return the page that a code span on another page refers to, "" if none."""
    if text.startswith("docs/") and text.endswith(".md"):
        return text.removeprefix("docs/").removesuffix(".md")
    if text.startswith("examples/"):
        return "generated/" + text.removesuffix(".py").removesuffix(".ipynb")
    words = text.split()
    if len(words) > 1 and words[0] == PROGRAM and words[1] in COMMANDS:
        return f"generated/commands/{words[1]}"
    if text in COMMANDS and seen_from.startswith("generated/commands/"):
        return f"generated/commands/{text}"
    return ""


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the transform."""
    app.add_post_transform(LinkCodeSpans)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
