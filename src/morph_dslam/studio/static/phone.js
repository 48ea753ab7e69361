// The page of a phone: records, and hands the video to the project.

import { upload } from './server.js';
import { recordButton } from './recorder.js';

const said = document.getElementById('said');
const app = {
  view: document.getElementById('view'),
  async doing(action) {
    try {
      return await action();
    } catch (error) {
      said.textContent = error.message;
      return undefined;
    }
  },
};
const { button } = recordButton(app, 'record', 'Record', 'phone', async ([file]) => {
  said.textContent = 'sending …';
  await upload('recording', file);
  said.textContent = 'The video is in the project. Record again to replace it.';
});
button.className = 'main';
document.getElementById('controls').append(button);
