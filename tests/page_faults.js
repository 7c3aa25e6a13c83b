// What a reader could not read on a page as it is laid out: a list of sentences, empty where all is well.
// A piece is a line of HTML text, or a line of text in a picture, as the four corners of its box:
// Matplotlib writes text as glyphs, so there a piece is a turned group of `use` elements, or a path
// where the text has a halo.
() => {
  const TOUCH = 1.0; // px that boxes may share: line boxes are higher than their letters
  const root = document.documentElement;

  const box = (r) => [[r.left, r.top], [r.right, r.top], [r.right, r.bottom], [r.left, r.bottom]];
  const bounds = (corners) => {
    const [x, y] = [0, 1].map((k) => corners.map((c) => c[k]));
    return { left: Math.min(...x), right: Math.max(...x), top: Math.min(...y), bottom: Math.max(...y) };
  };
  const meet = (a, b) => ({
    left: Math.max(a.left, b.left), right: Math.min(a.right, b.right),
    top: Math.max(a.top, b.top), bottom: Math.min(a.bottom, b.bottom),
  });
  const within = (a, b) =>
    a.left >= b.left - TOUCH && a.right <= b.right + TOUCH && a.top >= b.top - TOUCH && a.bottom <= b.bottom + TOUCH;
  const styled = (element, test) => {
    for (let e = element; e && e !== root; e = e.parentElement) if (test(getComputedStyle(e))) return e;
    return null;
  };
  const visible = (e) => e.checkVisibility({ opacityProperty: true, visibilityProperty: true });

  function lines() {
    const found = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
      const node = walker.currentNode, holder = node.parentElement;
      if (!node.data.trim() || holder.closest("svg, script, style") || !visible(holder)) continue;
      const range = document.createRange();
      range.selectNodeContents(node);
      const trim = parseFloat(getComputedStyle(holder).fontSize) * 0.12; // ascent and descent without ink
      for (const r of range.getClientRects())
        if (r.width > 1)
          found.push({
            text: node.data.trim().slice(0, 40), holder, owner: node,
            corners: box({ left: r.left, right: r.right, top: r.top + trim, bottom: r.bottom - trim }),
          });
    }
    return found;
  }

  function glyphs() {
    const found = [];
    for (const owner of document.querySelectorAll('svg g[id*="text_"]'))
      for (const line of owner.querySelectorAll(":scope > path, :scope > g:has(> use)")) {
        const b = line.getBBox(), m = line.getScreenCTM();
        if (!b.width || !visible(line)) continue;
        const corners = [[b.x, b.y], [b.x + b.width, b.y], [b.x + b.width, b.y + b.height], [b.x, b.y + b.height]]
          .map(([x, y]) => [m.a * x + m.c * y + m.e, m.b * x + m.d * y + m.f]);
        found.push({ text: owner.id, holder: owner.closest("svg"), owner, corners, drawn: line });
      }
    return found;
  }

  // Two convex shapes are apart if some side of one has all of the other beyond it.
  function overlap(a, b) {
    for (const shape of [a, b])
      for (let i = 0; i < shape.length; i++) {
        const [p, q] = [shape[i], shape[(i + 1) % shape.length]];
        const normal = [q[1] - p[1], p[0] - q[0]], length = Math.hypot(...normal) || 1;
        const [from, to] = [a, b].map((s) => s.map((c) => (c[0] * normal[0] + c[1] * normal[1]) / length));
        if (Math.min(Math.max(...from) - Math.min(...to), Math.max(...to) - Math.min(...from)) <= TOUCH) return false;
      }
    return true;
  }

  const pieces = [...lines(), ...glyphs()], faults = new Set();
  for (const piece of pieces) {
    piece.bounds = bounds(piece.corners);
    piece.scroller = styled(piece.holder, (s) => /auto|scroll/.test(s.overflowX));
    piece.shown = piece.scroller ? meet(piece.bounds, piece.scroller.getBoundingClientRect()) : piece.bounds;
    const cutter = piece.drawn ? piece.holder : styled(piece.holder, (s) => /hidden|clip/.test(s.overflowX + s.overflowY));
    if (cutter && !within(piece.bounds, cutter.getBoundingClientRect())) faults.add(`cut: ${piece.text}`);
    const cell = piece.holder.closest("td, th, dd, dt, pre");
    if (cell && !piece.drawn && !within(piece.bounds, cell.getBoundingClientRect()))
      faults.add(`out of its cell: ${piece.text}`);
    if (piece.shown.left < -TOUCH || (!piece.scroller && piece.bounds.right > root.clientWidth + TOUCH))
      faults.add(`beyond the page: ${piece.text}`);
  }
  if (root.scrollWidth > root.clientWidth) faults.add(`the page is ${root.scrollWidth} px wide`);

  pieces.sort((a, b) => a.bounds.top - b.bounds.top);
  pieces.forEach((a, i) => {
    for (let k = i + 1; k < pieces.length && pieces[k].bounds.top < a.bounds.bottom; k++) {
      const b = pieces[k];
      if (a.owner === b.owner) continue;
      const clipped = a.scroller !== b.scroller;
      const [one, other] = clipped ? [box(a.shown), box(b.shown)] : [a.corners, b.corners];
      if (clipped && [a, b].some((p) => p.shown.right <= p.shown.left || p.shown.bottom <= p.shown.top)) continue;
      if (overlap(one, other)) faults.add(`overlap: ${a.text} | ${b.text}`);
    }
  });
  return [...faults];
}
