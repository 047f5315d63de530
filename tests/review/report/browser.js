"use strict";

// As much of a browser as the report's script uses, for an engine without one. `page` is the page's element tree; a
// canvas notes what is drawn on it; time passes when the test calls `frame`.
class Element {
  constructor(node, parent) {
    [this.tag, this.attributes, this.parent] = [node.tag, node.attributes, parent];
    this.children = node.children.map((child) => new Element(child, this));
    this.textContent = node.text;
    this.hidden = "hidden" in this.attributes;
    this.checked = "checked" in this.attributes;
    this.value = this.attributes.value ?? "";
    if (this.tag === "select") {
      const options = this.children;
      const chosen = options.find((option) => "selected" in option.attributes) ?? options[0];
      this.value = chosen ? chosen.attributes.value ?? chosen.textContent : "";
    }
    this.dataset = {};
    for (const [name, value] of Object.entries(this.attributes)) {
      if (name.startsWith("data-")) this.dataset[name.slice(5)] = value;
    }
    const classes = new Set((this.attributes.class ?? "").split(" "));
    this.classList = {
      add: (name) => classes.add(name),
      contains: (name) => classes.has(name),
      toggle: (name) => classes.delete(name) || classes.add(name),
    };
    this.listeners = {};
    if (this.tag === "canvas") [this.clientWidth, this.clientHeight, this.drawn] = [600, 400, []];
  }

  addEventListener(kind, listener) {
    (this.listeners[kind] ??= []).push(listener);
  }

  dispatch(kind) {
    for (const listener of this.listeners[kind] ?? []) listener({ target: this });
  }

  matches(selector) {
    const [, tag, name, attribute, value] = selector.match(/^([a-z]*)(?:\.(\w+))?(?:\[(\w+)='?([^'\]]*)'?\])?$/);
    return (!tag || tag === this.tag) && (!name || this.classList.contains(name))
      && (!attribute || this.attributes[attribute] === value);
  }

  querySelectorAll(selector) {
    return this.children.flatMap((child) => [...(child.matches(selector) ? [child] : []), ...child.querySelectorAll(selector)]);
  }

  querySelector(selector) {
    return this.querySelectorAll(selector)[0] ?? null;
  }

  getContext() {
    const drawn = this.drawn;
    drawn.length = 0;
    const nothing = () => undefined;
    return {
      scale: nothing, beginPath: nothing, moveTo: nothing, lineTo: nothing, stroke: nothing, fill: nothing,
      arc: (x, y) => drawn.push({ x, y }),
      fillText: (text, x, y) => drawn.push({ text, x, y }),
    };
  }
}

let [now, waiting] = [0, []];
const document = new Element(page, null);
document.documentElement = document;
const window = { devicePixelRatio: 2, addEventListener() {}, matchMedia: () => ({ addEventListener() {} }) };
const performance = { now: () => now };
const getComputedStyle = () => ({ getPropertyValue: () => "black" });
const requestAnimationFrame = (callback) => waiting.push(callback);

/** Milliseconds pass, then one frame is drawn. Gives how many callbacks wait for the next. */
function frame(milliseconds) {
  now += milliseconds;
  const due = waiting;
  waiting = [];
  for (const callback of due) callback(now);
  return waiting.length;
}
