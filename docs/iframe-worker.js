// Search in pages that are opened from the disk: browsers start no worker there, so an invisible frame stands for one.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(address) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      this.waiting = [];
      document.documentElement.append(this.frame);
      const inside = this.frame.contentWindow;
      inside.document.open();
      inside.document.write("<!doctype html><html><body></body></html>");
      inside.document.close();
      inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      inside.importScripts = (...others) => Promise.all(others.map((other) => this.load(other)));
      this.load(address).then(() => {
        const waiting = this.waiting;
        this.waiting = null;
        for (const data of waiting) this.tell(data);
      });
    }

    load(address) {
      const script = this.frame.contentDocument.createElement("script");
      script.src = new URL(address, document.baseURI);
      this.frame.contentDocument.body.append(script);
      return new Promise((done) => (script.onload = done));
    }

    tell(data) {
      const inside = this.frame.contentWindow;
      inside.dispatchEvent(new inside.MessageEvent("message", { data }));
    }

    postMessage(data) {
      if (this.waiting) this.waiting.push(data);
      else this.tell(data);
    }
  };
}
