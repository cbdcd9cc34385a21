// Browsers start no worker from a file on disk. There the search runs in a hidden frame instead, so that it works offline.
if (location.protocol === "file:") {
  self.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      this.ready = new Promise(done => {
        document.body.append(frame);  // this script stands in the body
        const inside = frame.contentWindow;
        inside.document.open();
        inside.document.write("<!doctype html><html><body></body></html>");
        inside.document.close();
        inside.postMessage = data => {
          const message = new MessageEvent("message", { data });
          this.dispatchEvent(message);
          if (this.onmessage) this.onmessage(message);
        };
        const load = address => new Promise(loaded => {
          const script = inside.document.createElement("script");
          script.src = address;
          script.onload = loaded;
          inside.document.body.append(script);
        });
        inside.importScripts = (...addresses) => Promise.all(addresses.map(load));
        load(url).then(() => done(inside));
      });
    }

    postMessage(data) {
      this.ready.then(inside => inside.dispatchEvent(new MessageEvent("message", { data })));
    }

    terminate() {}
  };
}
