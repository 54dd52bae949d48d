// Show the dialog of an image; send the person's click, box or corners, in shares of the image, and the noun as one message.
(image) => {
  const dialog = image.closest("dialog"), [box, polygon, noun, button] = ["div>div", "polygon", "input", "button"].map((name) => dialog.querySelector(name));
  const isArea = dialog.dataset.most > 2, drawn = [];
  const answer = (prompt) => {
    dialog.close();
    // viser has no event for a click on HTML; its own tests send messages through this object
    const updates = { value: JSON.stringify({ prompt, noun: noun.value }) };
    window.__viserMutable.sendMessage({ type: "GuiUpdateMessage", uuid: dialog.id, updates });
  };
  const share = (event) => {
    const shown = image.getBoundingClientRect();
    const within = (value) => Math.min(Math.max(value, 0), 1);
    return [within((event.clientX - shown.left) / shown.width), within((event.clientY - shown.top) / shown.height)];
  };
  const corners = (event) => [0, 1].map((end) => [0, 1].map((axis) => Math[end ? "max" : "min"](start[axis], share(event)[axis])));
  let start = null;
  image.onpointerdown = (event) => {
    event.preventDefault();
    image.setPointerCapture(event.pointerId);
    start = share(event);
  };
  image.onpointermove = (event) => {
    if (!start || isArea) return;
    const [[left, top], [right, bottom]] = corners(event).map((corner) => corner.map((value) => 100 * value));
    box.style.cssText += `;display:block;left:${left}%;top:${top}%;width:${right - left}%;height:${bottom - top}%`;
  };
  image.onpointerup = (event) => {
    if (!start) return;
    const [first, last] = corners(event);
    if (isArea) {
      drawn.push(start);
      polygon.setAttribute("points", drawn.join(" "));
      start = null;
      return;
    }
    const moved_px = Math.max((last[0] - first[0]) * image.clientWidth, (last[1] - first[1]) * image.clientHeight);
    answer(moved_px > 4 ? [first, last] : [start]);
  };
  button.onclick = () => answer(drawn);
  dialog.oncancel = () => answer([]);
  dialog.showModal();
}
